"""Random numbers of rays: Mitsuba's sampler with a seed for every draw, Sobol's points, and points in cells of a grid.

Each kind is a class: `position` is where a ray starts in the open part of its pixel, `next_1d` and `next_2d` are the
numbers that lenses draw, and `spreads` is True if more rays, with less weight, go to faint parts of the point spread.

Mitsuba's stratified, multijitter and ldsampler number the permutations of successive draws: seed, seed + 1, ... Its
permutations of related numbers are related, so that some cells of the pupil hardly ever belong to some cells of the
pixel, in every pass. The mean over passes is then off by up to one standard deviation of a pass's mean, which the
scatter between passes cannot show. Unrelated seeds pair all cells equally often.

Sobol's points fill pixel and pupil together, scrambled after Owen with random numbers of each pixel and pass. A
scramble permutes every digit of a point depending on the digits before it, so that each point is uniform, and the mean
over a pass is unbiased; the passes are independent. The hash that scrambles is that of Laine and Karras (2011,
Stratified sampling for stochastic transparency). Samplers of Mitsuba stratify the pixel and the pupil each by itself.

Points of a grid follow from the pixel and its key alone. Mitsuba's samplers number their streams within all rays that
start together, so that the rays of a sub-imager would depend on which others start with it. These do not, and
sub-imagers are rendered together.
"""

# pyright: basic
from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import IntArray
from ommatid.runtime.streams import draw_seed

from .loaded import dr, mi

DIMENSIONS = 8  # of the points; what a ray draws beyond them is independent
BITS = 32
FACTORS = 0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6
SWAPS = (1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)
ROUNDS = 6  # of the Tiny Encryption Algorithm
MANTISSA = 24  # bits of a float32
GRID_ROUNDS = 4  # of the Tiny Encryption Algorithm, after which its numbers pass statistical tests (Zafar et al. 2010)


class ReseededSampler:
    """Draws the position from Mitsuba's sampler as it is, and all other numbers from it with seeds of their own."""

    spreads = False

    def __init__(self, sampler: Any, seed: int, lanes: int) -> None:
        """Wrap Mitsuba's sampler, which was seeded with `seed` for `lanes` rays."""
        self._sampler, self._seed, self._lanes, self._draws = sampler, seed, lanes, 0

    def position(self) -> Any:
        """Return the point of the pixel's open part where every ray starts."""
        return self._sampler.next_2d()

    def next_1d(self) -> Any:
        """Draw a number for every ray."""
        return self.reseeded().next_1d()

    def next_2d(self) -> Any:
        """Draw two numbers for every ray."""
        return self.reseeded().next_2d()

    @property
    def has_drawn(self) -> bool:
        """True once numbers were drawn."""
        return self._draws > 0

    def reseeded(self) -> Any:
        """Return Mitsuba's sampler with the next seed."""
        self._draws += 1
        self._sampler.seed(draw_seed(self._seed, self._draws), self._lanes)
        return self._sampler


@cache
def sobol_points(samples: int) -> NDArray[np.uint32]:
    """Return the first `samples` points, a power of two, as 32-bit fractions: (dimensions, samples)."""
    from scipy.stats import qmc

    points = qmc.Sobol(DIMENSIONS, scramble=False, bits=BITS).random_base2((samples - 1).bit_length())
    return np.ascontiguousarray((points * 2.0**BITS).astype(np.uint32).T)


class SobolDraws:
    """Draws numbers for every ray, dimension after dimension. Like Mitsuba's samplers, without their state."""

    def __init__(self, seed: int, lanes: int, samples: int, *, middle: bool = False) -> None:
        """Begin with the first dimension; `samples`, a power of two, are adjacent of `lanes` rays.

        middle : True starts all rays in the middle of the pixel, for a picture that is averaged over the pixel
        """
        self._seed, self._lanes, self._samples, self._dimension = seed, lanes, samples, 0
        self.spreads = middle

    def position(self) -> Any:
        """Return the point of the pixel's open part where every ray starts."""
        return mi.Point2f(0.5) if self.spreads else self.next_2d()

    def next_2d(self) -> Any:
        """Draw two numbers for every ray."""
        return mi.Point2f(self.next_1d(), self.next_1d())

    def next_1d(self) -> Any:
        """Draw a number for every ray."""
        dimension, self._dimension = self._dimension, self._dimension + 1
        lane: Any = dr.arange(mi.UInt32, self._lanes)
        stream = lane // dr.opaque(mi.UInt32, self._samples)
        hashed: Any = mi.sample_tea_32  # whose stub knows no arrays
        key = hashed(dr.opaque(mi.UInt32, self._seed), dr.opaque(mi.UInt32, dimension), ROUNDS)[0]
        if dimension >= DIMENSIONS:
            drawn = hashed(lane, key, ROUNDS)[0]
        else:
            points = mi.UInt32(sobol_points(self._samples)[dimension])
            drawn = dr.gather(mi.UInt32, points, lane - stream * dr.opaque(mi.UInt32, self._samples))
            drawn = _scrambled(drawn, hashed(stream, key, ROUNDS)[0])
        return mi.Float(drawn >> (32 - MANTISSA)) * 2.0**-MANTISSA


def _scrambled(value: Any, key: Any) -> Any:
    """Return 32-bit fractions after a permutation of each of their digits that depends on those before it."""
    value = _reversed(value) + key
    for factor in FACTORS:
        value ^= value * factor
    return _reversed(value)


def _reversed(value: Any) -> Any:
    for shift, mask in SWAPS:
        value = ((value >> shift) & mask) | ((value & mask) << shift)
    return value


class GridDraws:
    """One point in every cell of a grid over the pixel, for pinholes, which draw no other numbers."""

    spreads = False

    def __init__(self, cells: int, margin: float, keys: IntArray, numbers: IntArray) -> None:
        """Create `cells` x `cells` points for each pixel and pass, whose numbers follow from these alone.

        margin : to the edges of the cells, relative to their side
        keys : (pixels, passes) of 32 bits, of the pixel's sub-imager;  numbers : (pixels,) within the sub-imager
        """
        self._cells, self._margin, self._keys, self._numbers = cells, margin, keys, numbers

    def position(self) -> Any:
        """Return the point of the pixel's open part where every ray starts: the cells of a pixel by rows."""
        pixels, passes = self._keys.shape
        lane: Any = dr.arange(mi.UInt32, pixels * passes * self._cells**2)
        of_pass = lane // dr.opaque(mi.UInt32, self._cells**2)
        key: Any = dr.gather(mi.UInt32, mi.UInt32(self._keys.astype(np.uint32).ravel()), of_pass)
        numbers = mi.UInt32(self._numbers.astype(np.uint32))
        number: Any = dr.gather(mi.UInt32, numbers, of_pass // dr.opaque(mi.UInt32, passes))
        cells: Any = dr.opaque(mi.UInt32, self._cells)
        cell = lane % (cells * cells)
        row, first = cell // cells, mi.sample_tea_32(number, key, GRID_ROUNDS)
        draws = mi.sample_tea_32(first[0] + cell, first[1], GRID_ROUNDS)
        u, v = (mi.Float(draw >> (32 - MANTISSA)) * 2.0**-MANTISSA for draw in draws)
        margin, free = dr.opaque(mi.Float, self._margin), dr.opaque(mi.Float, 1 - 2 * self._margin)
        inverse: Any = dr.opaque(mi.Float, 1 / self._cells)
        column = cell - row * cells
        return mi.Point2f((column + margin + free * u) * inverse, (row + margin + free * v) * inverse)
