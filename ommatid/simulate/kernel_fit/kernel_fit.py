"""H of a blurred lens type by its kernels as designed, and by the mean deviation from these that rays show.

The entries of a chart of sensor pixels determine the deviation of each cell, the same over the field; that a lens shows
the mirrored picture at mirrored places averages it over eight images of the cells, or four. It is taken where it lowers
the expected error of H f, estimated without bias from the scatter of the batches (Mallows 1973, Technometrics 15, 661);
otherwise H is that of the design, with the errors of the deviation. F tests at 0.1 % for all together compare what is
left with that scatter: in all cells, and in the means over sub-imagers and over rings of the field. Kernels that leave
more than three times the noise in a picture, or a tenth of the entries' own variance, are rejected. What is less, and
shows in a picture, is added to the errors.

The directions in which the kernels are uncertain follow from fits to errors drawn from the scatter of the batches. A
draw gives every pixel of the chart a random combination of its batches' deviations, which has the covariance of the
pixel's errors; the fit to it is a draw of the kernels' error. Kept are the directions that change images most, of a
typical picture, whose values are correlated over a few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.lens_type import LensType

from ..calibration.fit.chart import Explanation
from ..calibration.responses import Responses
from ..ideal import designed_kernels
from .deviations import Chart, chart_of

SIGNIFICANCE = 0.001  # at which a correct model is rejected, by all tests together
SUPPORT = 0.01  # share of the chart's pixels that see a cell, below which it has no deviation
RINGS = 4  # of the field, with equally many pixels of the chart
SHOWN_PIXELS = 200  # of the chart, at most, for which errors in a picture are computed
DRAWS = 64
SHARE = 0.99  # of the expected variance of H f that the directions describe; they are scaled to all of it
MOST_DIRECTIONS = 16
MOST_SHOWN = 3.0  # of the variance that noise has in a picture: less is added to the errors
MOST_UNEXPLAINED = 0.1  # of the entries' variance, with which kernels are still far better than entries


@dataclass(frozen=True, eq=False)
class KernelFit:
    """Kernels of a lens type, if they explain the entries; `reason` names what they do not explain."""

    accepted: bool
    reason: str
    footprints: KernelFootprints | None = None
    details: dict[str, Any] = field(default_factory=dict[str, Any])

    def record(self) -> dict[str, Any]:
        """Return the entry of a model's record, in JSON's types."""
        return {"kind": "kernels", "accepted": self.accepted, "reason": self.reason, **self.details}


def fit_kernels(responses: Responses, camera: Camera, lens_type: LensType, pixels: IntArray | None = None) -> KernelFit:
    """Learn the kernels of a lens type from the rows of H of some of its pixels.

    pixels : of the type, (n,), whose rows were measured; None: those that have entries
    """
    obstacle = refusal(camera, lens_type)
    if obstacle:
        return KernelFit(False, obstacle)
    try:
        designed = designed_kernels(camera, lens_type).times(1 / float(lens_type.light))
    except InputError as error:
        return KernelFit(False, str(error))
    chart = chart_of(responses, designed, pixels)
    if chart is None:
        return KernelFit(False, "some pixels of the chart are dark")
    candidate = _chosen(chart)
    details, reason = _details(chart, candidate), ""
    if candidate.rejected:
        reason = f"the entries scatter more about the kernels than rays do ({', '.join(candidate.rejected)})"
    if candidate.shown > MOST_SHOWN or (candidate.rejected and candidate.unexplained > MOST_UNEXPLAINED):
        return KernelFit(False, reason, details=details)
    return KernelFit(True, reason, _footprints(chart, candidate).times(float(lens_type.light)), details)


def refusal(camera: Camera, lens_type: LensType) -> str:
    """Return why kernels cannot describe a lens type, empty if they can."""
    if not camera.walls:
        return "without walls, light of other lenses reaches its pixels"
    if lens_type.optics.distortion is not None:
        return "its images are distorted"
    if camera.tolerance is not None:
        return "its sub-imagers are misaligned"
    if lens_type.steered:
        return "some of its sub-imagers are off the grid"
    if not lens_type.is_aligned:
        return "its footprints cut pixels of f in different ways"
    return ""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A deviation of all rows, (C,), or None of the design.

    tests : of what it leaves, by name
    """

    deviation: FloatArray | None
    tests: dict[str, Explanation]

    @property
    def rejected(self) -> list[str]:
        """The tests that it does not pass."""
        single = -np.expm1(np.log1p(-SIGNIFICANCE) / len(self.tests))
        return [name for name, test in self.tests.items() if test.chance < single]

    @property
    def unexplained(self) -> float:
        """Mean square of what it leaves of an entry beside noise, in units of the entry's variance."""
        return self.tests["all cells"].excess

    @property
    def shown(self) -> float:
        """The largest excess of the tests of a picture that it does not pass, in units of the noise."""
        return max((self.tests[name].excess for name in self.rejected if name.endswith("picture")), default=0.0)


def _chosen(chart: Chart) -> _Candidate:
    """Return the mean deviation where it lowers the expected error and passes all tests, else the design if that does.

    If neither passes, it is the one of the least expected error.
    """
    count = len(chart.batches)
    mean = _fitted(chart, np.array([(each * chart.inside).sum(axis=0) for each in (chart.values, *chart.batches)]))
    some = np.unique(np.linspace(0, len(chart.pixels) - 1, SHOWN_PIXELS).round().astype(np.int64))
    shown = [float(np.square(chart.seen(each * chart.inside[some])).sum()) for each in mean]
    learnt = shown[0] > 2 * sum(shown[1:]) / (count * (count - 1))  # the bias of the design, and the noise of the mean
    best = _tested(chart, mean, learnt)
    if not (learnt and best.rejected):
        return best
    designed = _tested(chart, mean, False)
    return best if designed.rejected else designed


def _fitted(chart: Chart, sums: FloatArray) -> FloatArray:
    """Return the least squares of the cells, (k, C), from sums over the chart's pixels of entries that see them."""
    seen = _symmetric(chart, np.square(chart.inside).sum(axis=0))
    known = seen > SUPPORT * len(chart.pixels)
    return np.divide(_symmetric(chart, sums), seen, out=np.zeros_like(sums), where=known)


def _symmetric(chart: Chart, cells: FloatArray) -> FloatArray:
    """Return the mean of cells, (..., C), and their images: mirrored, and transposed if pixels are open by squares."""
    core, rings = np.split(cells, [chart.core**2], axis=-1)
    grid = core.reshape(*cells.shape[:-1], chart.core, chart.core)
    grid = (grid + grid[..., ::-1]) / 2
    grid = (grid + grid[..., ::-1, :]) / 2
    grid = (grid + grid.swapaxes(-1, -2)) / 2 if chart.is_square else grid
    return np.concatenate([grid.reshape(core.shape), rings], axis=-1)


def _tested(chart: Chart, mean: FloatArray, learnt: bool) -> _Candidate:
    """Test what a deviation leaves, or the design. mean : (1 + B, C) of the mean and of the batches' deviations"""
    heights: FloatArray = np.hypot(chart.field[:, 0], chart.field[:, 1])
    rings: IntArray = np.searchsorted(np.quantile(heights, np.arange(1, RINGS) / RINGS), heights, side="right")
    groups = {"sub-imagers": chart.sub_imagers, "field": rings}
    members = {name: _members(index) for name, index in groups.items() if np.ptp(index)}
    root, left, means = np.sqrt(chart.weights), list[FloatArray](), {name: list[FloatArray]() for name in members}
    for entries, each in zip((chart.values, *chart.batches), mean, strict=True):
        rest = entries - chart.inside * each if learnt else entries
        left.append(rest * root)
        for name, of in members.items():
            means[name].append(of @ rest / np.sqrt(np.maximum(of @ chart.inside, 1.0)))
    tests = {"all cells": _explanation(left)}
    for name, parts in means.items():
        tests[name] = _explanation([part * root for part in parts])
        tests[f"{name} in a picture"] = _explanation([chart.seen(part) for part in parts])
    return _Candidate(mean[0] if learnt else None, tests)


def _members(index: IntArray) -> FloatArray:
    """Return 1 where a pixel is in a group, (groups, pixels)."""
    return (index == np.unique(index)[:, None]).astype(np.float64)


def _explanation(residuals: list[FloatArray]) -> Explanation:
    """Compare the residuals of the mean with those of the batches."""
    flat = [part.ravel() for part in residuals]
    return Explanation.of(np.array([[np.dot(a, b) for b in flat] for a in flat], dtype=np.float64))


def _directions(chart: Chart, candidate: _Candidate) -> FloatArray:
    """Return errors of the kernels, (E, C), each with an independent factor of variance 1."""
    rng, count = probe(Purpose.KERNEL_ERRORS), len(chart.batches)
    sums = np.zeros((DRAWS, chart.inside.shape[1]))
    for batch in chart.batches:
        sums += rng.normal(size=(DRAWS, len(chart.pixels))) @ (batch * chart.inside) / (count * (count - 1)) ** 0.5
    errors = _fitted(chart, sums)
    shown = chart.seen(errors * chart.share**0.5)
    values, vectors = np.linalg.eigh(shown @ shown.T)
    total = float(values.sum())
    if total <= 0:
        return errors[:0]
    left: FloatArray = np.cumsum(values[::-1], dtype=np.float64)
    kept = min(int(np.searchsorted(left, SHARE * total)) + 1, MOST_DIRECTIONS)
    scale = ((1 + candidate.shown) * total / values[-kept:].sum() / DRAWS) ** 0.5
    return np.asarray(vectors[:, -kept:].T * scale @ errors, dtype=np.float64)


def _details(chart: Chart, candidate: _Candidate) -> dict[str, Any]:
    return {
        "lens": chart.places.lens_type.name,
        "pixels": len(chart.pixels),
        "rays_per_pixel": chart.rays,
        "width": chart.places.width,
        "core": chart.core,
        "as_designed": candidate.deviation is None,
        "chances": {name: test.chance for name, test in candidate.tests.items()},
        "unexplained": candidate.unexplained,
    }


def _footprints(chart: Chart, candidate: _Candidate) -> KernelFootprints:
    """Return H from the kernels of the design and the mean deviation."""
    designed, errors = chart.designed, _directions(chart, candidate)
    learnt = errors[:0] if candidate.deviation is None else candidate.deviation[None]
    (core, rings), (error_core, error_rings) = (np.split(each, [chart.core**2], axis=1) for each in (learnt, errors))
    square, terms = (-1, chart.core, chart.core), designed.coefficients.shape[1]
    shapes = replace(
        designed.shapes,
        core=core.reshape(square),
        rings=rings,
        error_core=error_core.reshape(square),
        error_rings=error_rings,
    )
    even = np.eye(1, terms)  # the constant term alone
    coefficients = np.concatenate([designed.coefficients, *[even] * len(learnt)])
    error_terms = np.eye(len(errors))[:, :, None] * even
    return KernelFootprints(designed.places, designed.degree, shapes.rounded, coefficients, error_terms)
