"""H of a blurred lens type by its kernels as designed, and by the mean deviation from these that rays show.

Rows of a chart of sensor pixels are taken in coordinates relative to the footprints of their pixels. Around a core,
which holds most of the light, the design gives the shape of the light, and only its amount in square rings is measured:
diffraction reaches far, and a cell there is met by few rays. Light beyond the design's kernels, of which rays have
none, is cut off.

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
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import Float32Array, FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import check_memory
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernel_shapes import KernelShapes, ring_masks
from ommatid.scenes.fitted.kernels import KernelFootprints, KernelPlaces
from ommatid.scenes.lens_type import LensType

from ...ideal import designed_kernels
from ..responses import Responses
from .chart import Explanation

LEAST_RAYS = 20.0  # in a cell, of all pixels: the fewest that its weight assumes, since few rays are not Gaussian
LEAST_SCATTER = 1e-3  # of independent rays' variance: the least that a weight assumes
CORE = 0.01  # of the largest light in a cell: cells with more are learnt one by one,
LEAST_INSIDE = 0.5  # of a ring's light that is on the target, from which a pixel tells of it
MOST_CORE = 48  # pixels of f along an axis: in a core of at most so many
VALUES_AT_ONCE = 2**24  # of kernels that are made for a part of the pixels
LEVEL = 3.0  # mean squared over variance of a picture whose values are uniform between 0 and 255
CORRELATED = 3.0  # pixels of f over which a picture's correlation falls to 1/e
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
class Chart:
    """Deviations from the design of n sensor pixels of a lens type in C = w^2 + B cells, those of the rings last.

    designed : H of the design;  core : w;  pixels : (n,) among those of the type
    values : (n, C), 0 beside the target;  batches : (B, n, C) deviations of the batches from these
    inside : (n, C) share of a cell's light that is on the target, 0 or 1 in the core
    light : (C,) of all pixels together;  rays : per pixel
    """

    designed: KernelFootprints
    core: int
    pixels: IntArray
    values: FloatArray
    inside: FloatArray
    batches: Float32Array
    light: FloatArray
    rays: int

    @property
    def places(self) -> KernelPlaces:
        """Where the kernels lie."""
        return self.designed.places

    @property
    def is_square(self) -> bool:
        """True if sensor pixels are open by squares."""
        return len(set(self.places.lens_type.open)) == 1

    @cached_property
    def field(self) -> FloatArray:
        """Positions (u, v) of the footprints: (n, 2)."""
        return self.places.positions(self.pixels)

    @cached_property
    def sub_imagers(self) -> IntArray:
        """The sub-imager of each pixel, numbered within the type: (n,)."""
        rows, columns = self.places.lens_type.pixels
        return self.pixels // (rows * columns)

    @cached_property
    def share(self) -> FloatArray:
        """Share of the pixels that see each cell: (C,)."""
        return self.inside.mean(axis=0)

    @cached_property
    def weights(self) -> FloatArray:
        """Inverse variances of a cell of one row, pooled over all rows: (C,), 0 for cells that no row has."""
        seen = self.inside.sum(axis=0)
        count = len(self.batches)
        squares = np.zeros(seen.size)
        for batch in self.batches:
            squares += np.square(batch, dtype=np.float64).sum(axis=0)
        variance = squares / (count * (count - 1)) / np.maximum(seen, 1)
        rate = (np.maximum(self.light * self.rays, 0.0) + LEAST_RAYS) / np.maximum(seen * self.rays, 1)
        single = LEAST_RAYS / np.maximum(seen * self.rays, 1) / self.rays
        floor = np.maximum(single, LEAST_SCATTER * rate / self.rays)
        return np.where(seen > 0, 1 / np.maximum(variance, floor), 0.0)

    def seen(self, errors: FloatArray) -> FloatArray:
        """Return errors of kernels, (..., C), in coordinates whose squares add up to the variance of H f: (..., C + 1).

        The picture has a variance of 1, and a correlation that falls exponentially down and across; rings count as if
        they were not correlated.
        """
        core, rings = np.split(errors, [self.core**2], axis=-1)
        values, vectors = np.linalg.eigh(_correlation(self.core))
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        varied = root @ core.reshape(*core.shape[:-1], self.core, self.core) @ root
        level = LEVEL**0.5 * errors.sum(axis=-1, keepdims=True)
        return np.concatenate([varied.reshape(core.shape), rings * self._ring_deviations, level], axis=-1)

    @cached_property
    def _ring_deviations(self) -> FloatArray:
        """Deviation of the picture's mean over each ring, by the design's light: (B,)."""
        correlation = _correlation(self.places.width)
        found: list[float] = []
        for mask in ring_masks(self.places.width, self.core):
            ring = np.where(mask, self.designed.shapes.designed[0], 0.0)
            ring /= ring.sum() or 1.0
            found.append(float(np.sum(ring * (correlation @ ring @ correlation))) ** 0.5)
        return np.array(found)


def _correlation(size: int) -> FloatArray:
    place = np.arange(size, dtype=np.float64)
    return np.exp(-np.abs(place[:, None] - place) / CORRELATED)


def chart_of(responses: Responses, designed: KernelFootprints, pixels: IntArray | None = None) -> Chart | None:
    """Return the chart of a lens type, or None if one of its pixels is dark.

    designed : H of the design;  pixels : of the type, that the chart holds; None: those with light
    """
    camera, lens_type = designed.places.camera, designed.places.lens_type
    type_rows = camera.type_slices()[camera.types.index(lens_type)]
    matrix = responses.matrix[type_rows]
    counts = np.diff(matrix.indptr)
    pixels = np.flatnonzero(counts) if pixels is None else pixels
    if not pixels.size or not counts[pixels].all():
        return None
    margin = max(designed.places.margin, _margin(designed.places, matrix))
    places = replace(designed.places, margin=margin)
    cell, wide = _cells(places, matrix), places.width
    beside = margin - designed.places.margin
    down, across = (np.pad(each, ((beside, beside), (0, 0))) for each in (designed.shapes.down, designed.shapes.across))
    measured = np.bincount(cell, weights=matrix.data, minlength=wide**2).reshape(wide, wide) / pixels.size
    mean = np.pad(designed.shapes.designed[0], beside)
    core = _core(np.maximum(measured, mean))
    masks = ring_masks(wide, core)
    none = np.zeros((0, core, core)), np.zeros((0, len(masks)))
    designed = replace(
        designed, places=places, shapes=KernelShapes(down, across, designed.shapes.products, *none, *none)
    )
    size = core**2 + len(masks)
    needed = pixels.size * size * (8 + 8 + 4 * len(responses.batches))
    check_memory(2 * needed, f"the kernels of lens type {lens_type.name}", "calibrate with calibration.fit = 'none'")
    index = np.full(counts.size, -1)
    index[pixels] = np.arange(pixels.size)
    row = index[np.repeat(np.arange(counts.size), counts)]
    where = row * size + _numbers(wide, core)[cell]
    first = int(responses.matrix.indptr[type_rows.start])

    def summed(entries: FloatArray | Float32Array) -> FloatArray:
        total = np.bincount(where, weights=entries, minlength=pixels.size * size)
        return np.asarray(total, dtype=np.float64).reshape(pixels.size, size)

    values = summed(matrix.data)
    batches = np.array([summed(each[first : first + matrix.nnz]) for each in responses.batches], dtype=np.float32)
    expected, inside = _expected(designed, core, pixels)
    beside = inside < LEAST_INSIDE
    for each in (values, expected, inside, *batches):
        each[beside] = 0.0
    rays, light = responses.work.total, values.sum(axis=0)
    return Chart(designed, core, pixels, values - expected, inside, batches, light, rays)


def _expected(designed: KernelFootprints, core: int, pixels: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the design's light on the target in each cell, and its share of all light there: (n, C) each."""
    places, shape = designed.places, designed.shape
    wide, mean, masks = places.width, designed.shapes.designed[0], ring_masks(places.width, core)
    middle = slice((wide - core) // 2, (wide + core) // 2)
    expected, shares = list[FloatArray](), list[FloatArray]()
    step = 1 + VALUES_AT_ONCE // (wide * wide)
    for part in (pixels[first : first + step] for first in range(0, pixels.size, step)):
        down, across = ((cells >= 0) & (cells < size) for cells, size in zip(places.cells(part), shape, strict=True))
        inside = down[:, :, None] & across[:, None]
        values = np.where(inside, designed.values(part), 0.0)
        rings = [values[:, mask].sum(axis=1) for mask in masks]
        lit = [inside[:, mask] @ mean[mask] / (mean[mask].sum() or 1.0) for mask in masks]
        for found, cells, sums in ((expected, values, rings), (shares, inside, lit)):
            flat = cells[:, middle, middle].reshape(part.size, -1)
            found.append(np.column_stack([flat.astype(np.float64), *sums]))
    return np.concatenate(expected), np.concatenate(shares)


def _core(light: FloatArray) -> int:
    """Return the width of the square in the middle, of W x W, that holds all cells with much light."""
    wide = len(light)
    offset = np.abs(2 * np.arange(wide) + 1 - wide)
    lit = light > CORE * light.max()
    width = int(np.maximum.outer(offset, offset)[lit].max()) + 1
    return min(width, MOST_CORE - (wide - MOST_CORE) % 2)


def _numbers(wide: int, core: int) -> IntArray:
    """Return the number among C of each of W x W cells: (W^2,)."""
    numbers = np.zeros((wide, wide), dtype=np.int64)
    middle = slice((wide - core) // 2, (wide + core) // 2)
    numbers[middle, middle] = np.arange(core**2).reshape(core, core)
    for number, mask in enumerate(ring_masks(wide, core)):
        numbers[mask] = core**2 + number
    return numbers.ravel()


def _offsets(places: KernelPlaces, matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Return row and column of each entry, from the corner of its pixel's kernel: (nnz,) each."""
    pixel = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    row, column = places.lines(pixel)
    down, across = np.divmod(matrix.indices.astype(np.int64), places.camera.columns)
    return down - places.starts[0][row], across - places.starts[1][column]


def _cells(places: KernelPlaces, matrix: sparse.csr_array) -> IntArray:
    down, across = _offsets(places, matrix)
    return down * places.width + across


def _margin(places: KernelPlaces, matrix: sparse.csr_array) -> int:
    """Return the pixels of f beyond a footprint that light reaches on any side."""
    last = int(places.lens_type.ratio) - 1
    offsets = _offsets(replace(places, margin=0), matrix)
    return max(max(-int(offset.min()), int(offset.max()) - last, 0) for offset in offsets)


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
    tests = {"all cells": Explanation.of(left)}
    for name, parts in means.items():
        tests[name] = Explanation.of([part * root for part in parts])
        tests[f"{name} in a picture"] = Explanation.of([chart.seen(part) for part in parts])
    return _Candidate(mean[0] if learnt else None, tests)


def _members(index: IntArray) -> FloatArray:
    """Return 1 where a pixel is in a group, (groups, pixels)."""
    return (index == np.unique(index)[:, None]).astype(np.float64)


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
