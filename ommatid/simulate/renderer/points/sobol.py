"""Points of pixel and pupil together: Sobol's, scrambled after Owen with random numbers of each pixel and pass.

A scramble permutes every digit of a point depending on the digits before it, so that each point is uniform, and the
mean over a pass is unbiased; the passes are independent. The hash that scrambles is that of Laine and Karras
(2011, Stratified sampling for stochastic transparency). Samplers of Mitsuba stratify the pixel and the pupil each by
itself.
"""

# pyright: basic
from __future__ import annotations

from typing import Any

from ...sampling.sobol import DIMENSIONS, sobol_points

FACTORS = 0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6
SWAPS = (1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)
ROUNDS = 6  # of the Tiny Encryption Algorithm
MANTISSA = 24  # bits of a float32


class SobolDraws:
    """Draws numbers for every ray, dimension after dimension. Like Mitsuba's samplers, without their state."""

    has_drawn = False  # Mitsuba's sampler has drawn nothing

    def __init__(self, seed: int, lanes: int, samples: int) -> None:
        """Begin with the first dimension; `samples`, a power of two, are adjacent of `lanes` rays."""
        self._seed, self._lanes, self._samples, self._dimension = seed, lanes, samples, 0

    def next_2d(self) -> Any:
        """Draw two numbers for every ray."""
        import mitsuba as mi

        return mi.Point2f(self.next_1d(), self.next_1d())

    def next_1d(self) -> Any:
        """Draw a number for every ray."""
        import drjit as dr
        import mitsuba as mi

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
