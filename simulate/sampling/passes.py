"""Rendering in passes with seeds of their own, so that every mean comes with the variance of its own error."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import ceil, isqrt

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.scene import Sampler

from .checkpoint import State
from .samplers import filling, fitting

Vector = NDArray[np.float64]

BATCHES = 8  # passes are also averaged in this many batches, whose scatter shows how errors go together
FEWEST_PASSES = 16
MOST_SAMPLES = 4096  # in one pass: the renderer's sums are float32
JITTERED: tuple[Sampler, ...] = ("multijitter", "stratified")  # one sample in every cell of a grid
MOST_CELLS = 16  # along a side of a grid that fits the edges of pixels of f
ROUNDING = 2.0**-24  # relative, of float32


@dataclass(frozen=True)
class Plan:
    """How many passes, and how many samples a pixel in each."""

    passes: int
    samples: int

    @property
    def total(self) -> int:
        """Samples a pixel of all passes."""
        return self.passes * self.samples


def plan(samples: int, sampler: Sampler = "multijitter") -> Plan:
    """Divide `samples` a pixel over at least 16 passes, rounding up to a grid that the sampler can fill."""
    passes = max(FEWEST_PASSES, BATCHES * ceil(samples / MOST_SAMPLES / BATCHES))
    return Plan(passes, fitting(sampler, ceil(samples / passes)))


def on_grid(samples: int, sampler: Sampler, cells: int = 1, most: int = MOST_SAMPLES) -> Plan:
    """At least `samples` a pixel in passes, none of more than `most`: for squares, on a grid of a multiple of `cells`.

    Where a pixel sees cells x cells whole pixels of f, such a grid puts equally many samples into each of them, and a
    sampler that jitters within its cells gives the pixel's value without any error. Sides are few, 1, 2, 3, 4, 6, 8,
    12, ... times `cells`: Mitsuba compiles for every one.
    """
    each = ceil(samples / FEWEST_PASSES)
    times = ceil((isqrt(max(each - 1, 0)) + 1) / cells)
    power = 1 << (times - 1).bit_length()
    side = cells * (3 * power // 4 if power >= 4 and times <= 3 * power // 4 else power)
    fits = side**2 if sampler in JITTERED else fitting(sampler, each)
    if fits <= most:
        return Plan(FEWEST_PASSES, fits)
    fits = (max(isqrt(most) // cells, 1) * cells) ** 2 if sampler in JITTERED else _filling(sampler, most)
    return Plan(max(FEWEST_PASSES, BATCHES * ceil(samples / fits / BATCHES)), fits)


_filling = cache(filling)


def cells_of(ratio: Fraction) -> int:
    """Along one side of a sensor pixel that covers `ratio` pixels of f: into how many alike their edges can cut it."""
    return ratio.numerator if ratio.numerator <= MOST_CELLS else 1


@dataclass(frozen=True)
class OverPasses:
    """How a mean over passes was made: passes, samples a pixel in each, Mitsuba's variant, the first sampler's seed."""

    passes: int
    samples: int
    variant: str
    first_seed: int

    def record(self) -> dict[str, int | str]:
        """What the file that holds the mean says of it; samples are those of all passes."""
        return {
            "samples": self.passes * self.samples,
            "passes": self.passes,
            "variant": self.variant,
            "first_seed": self.first_seed,
        }


class Tally:
    """Running mean and variance over passes of arrays of one shape (Welford), in float64."""

    def __init__(self, *shape: int) -> None:
        """Start empty."""
        self.count = 0
        self._mean = np.zeros(shape)
        self._squares = np.zeros(shape)

    def state(self, name: str) -> State:
        """All of it, to be kept under `name`."""
        return {f"{name}.count": np.array(self.count), f"{name}.mean": self._mean, f"{name}.squares": self._squares}

    def resume(self, name: str, state: State) -> None:
        """Go on where a kept one of this name stopped, if there is one."""
        if f"{name}.count" in state:
            self.count = int(state[f"{name}.count"])
            self._mean, self._squares = state[f"{name}.mean"], state[f"{name}.squares"]

    def add(self, values: Vector) -> None:
        """Take in one more pass."""
        self.count += 1
        away = values - self._mean
        self._mean += away / self.count
        self._squares += away * (values - self._mean)

    @property
    def mean(self) -> Vector:
        """Mean over the passes."""
        return self._mean

    @property
    def variance(self) -> Vector:
        """Unbiased variance of that mean, from the scatter of the passes alone; NaN of a single one."""
        if self.count < 2:
            return np.full_like(self._mean, np.nan)
        return self._squares / (self.count * (self.count - 1))


def rounding_variance(values: Vector, samples: int) -> Vector:
    """Variance that float32 leaves in a mean of `samples` values: of its storage, and of the sums it came from.

    A value of 0 is given the rounding of 1, since noise of exactly 0 has no inverse.
    """
    return ((np.abs(values) * (1 + samples / 8) + 1) * ROUNDING) ** 2


def samples_within(values: Vector, variance: Vector) -> int:
    """The most samples whose rounding, as `rounding_variance` has it, leaves no more than `variance`; 1 at least."""
    sums = (np.sqrt(variance) / ROUNDING - 1) / np.maximum(np.abs(values), ROUNDING)
    return max(int(8 * (float(sums.min()) - 1)), 1)
