"""Rendering in passes with independent seeds: their plans, means with variances, and the samples that a goal takes.

Passes are divided over grids that the sampler fills, over a power of two of Sobol's points, or over a grid that leaves
no error: behind an ideal pinhole a pixel averages a constant over each cell that lies within one pixel of f, wherever
in it the sample is. Two passes suffice then: that they agree shows that nothing but the rounding of float32 is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import ceil, isqrt, lcm, log
from typing import Any, Literal

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import Rays, sampler_seeds
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.tables.estimation import Sampler

from .checkpoint import State
from .samplers import filling, fitting

BATCHES = 8  # passes are also averaged in this many batches, whose scatter shows the correlation of errors
FEWEST_PASSES = 16
MOST_SAMPLES = 4096  # in one pass: the renderer's sums are float32
JITTERED = ("multijitter", "stratified")  # one sample in every cell of a grid
MOST_CELLS = 16  # along a side of a grid that fits the edges of pixels of f
ROUNDING = 2.0**-24  # relative, of float32
EXACT_PASSES = 2  # of such a grid
ROUNDINGS = 16  # of float32, from the sensor to the target: more than add up on a ray's way
WIDEST_MARGIN = 0.125  # of a cell, beyond which float32 does not resolve the cells
MOST_PIXELS = 64  # of f, of a sensor pixel along an axis, whose averages are computed
MOST_PARTS = 4  # of a pixel of f along an axis, likewise
STRATIFIED, INDEPENDENT = 1.5, 1.0  # exponents before they are measured: of strata only those along edges err
STEEPEST = 2.0  # largest exponent that a measurement is trusted with
LEAPS = (2.0, 64.0)  # least and largest growth of the samples from one round to the next


@dataclass(frozen=True)
class Plan:
    """Number of passes, and of samples per pixel in each."""

    passes: int
    samples: int

    @property
    def total(self) -> int:
        """Samples per pixel of all passes."""
        return self.passes * self.samples

    def record(self, variant: str, seed: int, rays: Rays) -> dict[str, Any]:
        """Return the entries for the record of a stack or a model, with Mitsuba's variant and its first seed."""
        first = sampler_seeds(seed, rays, 0, self.passes)(0)
        return {"samples": self.total, "passes": self.passes, "variant": variant, "first_seed": first}


Plans = dict[str, Plan]  # by the name of a lens type


@dataclass(frozen=True)
class SampleLaw:
    """A variance that falls as 1 / passes and as samples^-exponent, with the samples of a pass."""

    exponent: float = INDEPENDENT

    @staticmethod
    def expected(sampler: Sampler) -> SampleLaw:
        """Return the law of a sampler through pinholes."""
        return SampleLaw(INDEPENDENT if sampler == "independent" else STRATIFIED)

    @staticmethod
    def measured(fall: float, growth: float) -> SampleLaw:
        """Return the law of a variance that fell by a factor while the samples grew by another, within limits."""
        return SampleLaw(min(max(log(fall) / log(growth), INDEPENDENT), STEEPEST))

    def ratio(self, few: Plan, many: Plan) -> float:
        """Return the variance by the second plan over that by the first."""
        return few.passes / many.passes * (few.samples / many.samples) ** self.exponent

    def samples(self, factor: float, last: Plan, most: int) -> int:
        """Predict the samples per pixel of a round that divides the variance of the last one by a factor.

        most : in a pass. A round takes at least twice as many samples as the last one, and not too many more.
        """
        each = last.samples * (factor * last.passes / FEWEST_PASSES) ** (1 / self.exponent)
        total = FEWEST_PASSES * each
        if each > most:
            total = most * last.passes * factor * (last.samples / most) ** self.exponent
        return ceil(min(max(total, LEAPS[0] * last.total), LEAPS[1] * last.total))


def plan(samples: int, sampler: Sampler = "multijitter") -> Plan:
    """Divide `samples` per pixel over at least 16 passes, rounded up to a grid that the sampler can fill."""
    passes = max(FEWEST_PASSES, BATCHES * ceil(samples / MOST_SAMPLES / BATCHES))
    return Plan(passes, fitting(sampler, ceil(samples / passes)))


def on_grid(samples: int, sampler: Sampler | Literal["sobol"], cells: int = 1, most: int = MOST_SAMPLES) -> Plan:
    """Divide at least `samples` per pixel over passes of at most `most`, on grids of a multiple of `cells` a side.

    Where a sensor pixel sees cells x cells whole pixels of f, such a grid puts equally many samples into each of them,
    and a sampler that jitters within its cells gives the pixel's value without any error. Sides are few, 1, 2, 3, 4,
    6, 8, 12, ... times `cells`, since Mitsuba compiles anew for every one.
    """
    each = ceil(samples / FEWEST_PASSES)
    times = ceil((isqrt(max(each - 1, 0)) + 1) / cells)
    power = 1 << (times - 1).bit_length()
    side = cells * (3 * power // 4 if power >= 4 and times <= 3 * power // 4 else power)
    fits = side**2 if sampler in JITTERED else fitting(sampler, each)
    if fits <= most:
        return Plan(FEWEST_PASSES, fits)
    fits = (max(isqrt(most) // cells, 1) * cells) ** 2 if sampler in JITTERED else filling(sampler, most)
    return Plan(max(FEWEST_PASSES, BATCHES * ceil(samples / fits / BATCHES)), fits)


def cells_of(lens_type: LensType) -> int:
    """Return the number of equal parts that edges of pixels of f can cut both sides of a pixel's footprint into."""
    cells = lcm(*(side.numerator for side in lens_type.footprint))
    return cells if cells <= MOST_CELLS else 1


@dataclass(frozen=True)
class Rendering:
    """Light on every sensor pixel, (M,): the mean of passes, and the variance of that mean from their scatter.

    stated : (M,) the variance, shrunk among the pixels and never below rounding; as it is of a single pass
    record : entries for the stack's record
    direct_only : True if interreflections in a world were left out, since nothing there reflects
    """

    mean: FloatArray
    variance: FloatArray
    stated: FloatArray
    record: dict[str, Any]
    direct_only: bool

    @property
    def passes(self) -> int:
        """Number of passes, of all rounds if there were several."""
        return int(self.record["passes"])


class Tally:
    """Running mean and variance over passes of arrays of one shape (Welford), in float64."""

    def __init__(self, *shape: int) -> None:
        """Create an empty tally."""
        self.count = 0
        self._mean = np.zeros(shape)
        self._squares = np.zeros(shape)

    @staticmethod
    def of(passes: FloatArray) -> Tally:
        """Return the tally of passes: (passes, ...)."""
        tally = Tally(*passes.shape[1:])
        for values in passes:
            tally.add(values)
        return tally

    def state(self, name: str) -> State:
        """Return the arrays of a checkpoint, under keys that begin with `name`."""
        return {f"{name}.count": np.array(self.count), f"{name}.mean": self._mean, f"{name}.squares": self._squares}

    def resume(self, name: str, state: State) -> None:
        """Continue from a checkpoint, if it holds a tally of this name."""
        if f"{name}.count" in state:
            self.count = int(state[f"{name}.count"])
            self._mean, self._squares = state[f"{name}.mean"], state[f"{name}.squares"]

    def add(self, values: FloatArray) -> None:
        """Add one pass. An interruption leaves the tally as it was."""
        deviation, count = values - self._mean, self.count + 1
        mean = self._mean + deviation / count
        deviation *= values - mean
        deviation += self._squares
        self.count, self._mean, self._squares = count, mean, deviation

    @property
    def mean(self) -> FloatArray:
        """Mean over the passes."""
        return self._mean

    @property
    def variance(self) -> FloatArray:
        """Unbiased variance of that mean, from the scatter of the passes alone; NaN for a single pass."""
        if self.count < 2:
            return np.full_like(self._mean, np.nan)
        return self._squares / (self.count * (self.count - 1))


def rounding_variance(values: FloatArray, samples: int) -> FloatArray:
    """Return the variance that float32 leaves in a mean of `samples` values, by storage and by summation.

    A value of 0 is given the rounding of 1, since noise of exactly 0 has no inverse.
    """
    return ((np.abs(values) * (1 + samples / 8) + 1) * ROUNDING) ** 2


def samples_within(values: FloatArray, variance: FloatArray) -> int:
    """Return the largest number of samples, at least 1, whose `rounding_variance` does not exceed `variance`."""
    sums = (np.sqrt(variance) / ROUNDING - 1) / np.maximum(np.abs(values), ROUNDING)
    return max(int(8 * (float(sums.min()) - 1)), 1)


# Exact averages over pixels, one a pass, moved up, down, left and right by what float32 may round.
AVERAGED = Plan(4, 1)


def exact_plan(camera: Camera, index: int, sampler: Sampler, *, fast: bool = True) -> Plan | None:
    """Return the passes that show a flat target to sub-imager `index` without error; None if none do.

    fast : True if the averages of the picture over its pixels can be had, one a pass
    """
    sub = camera.sub_imagers[index]
    if sampler not in JITTERED or not sub.type.optics.is_pinhole:
        return None
    ends: list[Fraction] = []
    for start, inset, side in zip(sub.window, sub.type.inset, sub.type.footprint, strict=True):
        ends += [(start + inset) * side.denominator, sub.type.ratio * side.denominator]  # the next pixel begins there
    cells = lcm(*(side.numerator for side in sub.type.footprint))
    fits = cells <= MOST_CELLS and all(end.denominator == 1 for end in ends)
    is_ideal = camera.walls and camera.tolerance is None and not sub.rotation
    if fits and is_ideal and margin(camera, sub.type) <= WIDEST_MARGIN:
        return Plan(EXACT_PASSES, cells**2)
    return AVERAGED if fast and has_equal_boxes(camera, sub.type) else None


def has_equal_boxes(camera: Camera, lens_type: LensType) -> bool:
    """Return True if all pixels of a lens type throw equal boxes along the axes of the picture, and not too large."""
    sides, tolerance = lens_type.footprint, camera.tolerance
    small = all(side.numerator <= MOST_PIXELS and side.denominator <= MOST_PARTS for side in sides)
    displaced = tolerance is not None and tolerance.displaces and lens_type.optics.is_pinhole
    straight = camera.walls and not lens_type.is_rotated and (tolerance is None or displaced)
    return small and straight and lens_type.optics.surfaces is None and lens_type.optics.distortion is None


def margin(camera: Camera, lens_type: LensType) -> float:
    """Return by how much of a cell rounding may move the point of the target that a ray of a lens type meets."""
    away = max(abs(place) for sub in camera.sub_imagers for place in sub.lens)
    extent = max(camera.shape) + away / camera.target_pitch  # pixels of f
    return ROUNDINGS * ROUNDING * extent * max(side.denominator for side in lens_type.footprint)
