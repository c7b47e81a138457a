"""The expected error (Eq. 5) of every pixel of a frame whose lens types see the same everywhere.

Far from the edges it is that of the transfer functions for the noise of the measurements near a pixel. Strips with the
same edges, and a small frame at the corners, show how much larger it is near them. Of few pixels the covariances are
matrices, and the map is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import processors

from ..forms.cholesky import factorise_positive
from ..methods.method import EstimationTask
from ..prior import averaged_spectrum, cosine_waves
from ..problem import dense_or_sparse, gram
from .bands import Bands
from .readings import leaves_null_space
from .swept import swept_maps

SIDE, FINE_SIDE, QUICK_SIDE = 40, 18, 24  # pixels of f of a small frame, where the world is finer, and for a mean
LINES, LEAST_LINES = 120, 24  # of f between the edges of a strip: for a world as fine as f, and for any
ALONG = 64  # pixels of f along it, which has no edges there
GRID = 64  # pixels of f along an axis of a frame of reflecting edges
DEEP = 9  # of a strip along an edge, in kernels; half of it is used
LONG, SHORT = 60, 44  # of small frames from which the effect of the length follows
LEAST_SHARE = 0.1  # of a variance in the longest of them, which that in a large one is at least
LEAST = 1e-10  # of the posterior variance, that its parts are where edges are compared with the interior
COLUMNS = 128  # readings whose covariances are computed at once
INTERIOR, EDGES = 9, 4  # levels of noise at which the two are computed; others follow from them
EVEN, EVEN_EDGES = 1e-3, 0.1  # range of levels, logarithms, that count as one

Way = Literal["edges", "far", "swept"]  # strips and a corner, small frames, or whole strips of independent pixels
Maps = Callable[[float], FloatArray]  # from the logarithm of a level to three maps


@dataclass(frozen=True)
class VarianceMap:
    """Maps over the pixels: the diagonal of C, and the parts of Eq. 5 due to the prior and due to the noise."""

    posterior: FloatArray
    missing: FloatArray
    noisy: FloatArray

    @property
    def variance(self) -> FloatArray:
        """Eq. 5 of all pixels, (N,)."""
        return np.maximum(self.missing + self.noisy, 0.0).ravel()


@dataclass(frozen=True)
class Moments:
    """Prior covariances of f's pixels and the readings: (N,) diagonal, (N, M) of both, (M, M) of the readings."""

    pixels: FloatArray
    both: FloatArray
    readings: FloatArray

    def at(self, pixels: NDArray[np.intp]) -> Moments:
        """Return those of some pixels of f, (n,)."""
        return Moments(self.pixels[pixels], self.both[pixels], self.readings)

    def factor(self, noise: FloatArray) -> tuple[FloatArray, bool]:
        """Return the Cholesky factor of the covariance of readings with these noise variances, (M,)."""
        covariance = self.readings + np.diag(noise)
        return linalg.cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)

    def variances(self, expected: FloatArray, actual: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Return the three maps for readings with these noise variances, (M,): (3, rows, columns)."""
        gain = np.asarray(linalg.cho_solve(self.factor(expected), self.both.T, check_finite=False)).T
        posterior = self.pixels - np.einsum("ij,ij->i", gain, self.both)
        squares = np.square(gain)
        missing = np.maximum(posterior - squares @ expected, 0.0)
        return np.array([np.maximum(posterior, 0.0), missing, squares @ actual]).reshape(3, *shape)


def moments(matrix: sparse.csr_array, spectrum: FloatArray, detail: int) -> Moments:
    """Return the covariances for H, (M, pixels of the world), and the prior's spectrum, (F rows, F columns)."""
    fine, shape = spectrum.shape, (spectrum.shape[0] // detail, spectrum.shape[1] // detail)
    count = matrix.shape[0]
    both, readings = np.empty((shape[0] * shape[1], count)), np.empty((count, count))
    applied = dense_or_sparse(matrix)
    for start in range(0, count, COLUMNS):
        part = slice(start, min(start + COLUMNS, count))
        waves = fft.dctn(matrix[part].toarray().reshape(-1, *fine), 2, axes=(1, 2), norm="ortho", workers=processors())
        waves *= spectrum
        spread = np.asarray(fft.idctn(waves, 2, axes=(1, 2), norm="ortho", workers=processors(), overwrite_x=True))
        means = spread.reshape(-1, shape[0], detail, shape[1], detail).mean(axis=(2, 4))
        both[:, part] = means.reshape(len(spread), -1).T
        readings[:, part] = applied @ spread.reshape(len(spread), -1).T
    vertical, horizontal = (np.square(cosine_waves(size)) for size in shape)
    pixels = (vertical @ averaged_spectrum(spectrum, detail) @ horizontal.T).ravel()
    return Moments(pixels, both, (readings + readings.T) / 2)


def prior_precision(prior: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return P0^-1 of a small frame as a matrix, (N, N), from 1 / its spectrum under the DCT-II."""
    down, across = (cosine_waves(size) for size in shape)
    pairs = [(waves[:, None, :] * waves[None, :, :]).reshape(-1, waves.shape[1]) for waves in (down, across)]
    (rows, columns), count = shape, shape[0] * shape[1]
    products = (pairs[0] @ prior @ pairs[1].T).reshape(rows, rows, columns, columns)
    return np.ascontiguousarray(products.transpose(0, 2, 1, 3)).reshape(count, count)


def dense_maps(
    matrix: sparse.csr_array,
    noise: tuple[FloatArray, FloatArray],
    precision: FloatArray,
    prior: FloatArray,
    pixels: NDArray[np.intp],
) -> FloatArray:
    """Return the three maps of pixels of a small frame: (3, n).

    matrix : (M, N) H;  noise : (M,) 1 / Rv, and Rvm / Rv;  precision : (N, N) K
    prior : (rows, columns) 1 / the spectrum of P0;  pixels : (n,) in ascending order
    """
    factor, _ = factorise_positive(precision)
    if pixels.size == precision.shape[0]:
        covariance = factor.inverse()
    else:
        units = np.zeros((precision.shape[0], pixels.size))
        units[pixels, np.arange(pixels.size)] = 1.0
        covariance = factor.solve(units)
    waves = np.asarray(fft.dctn(covariance.reshape(*prior.shape, -1), 2, axes=(0, 1), norm="ortho"))
    missing = np.einsum("rc,rcn->n", prior, np.square(waves))
    posterior = covariance[pixels, np.arange(pixels.size)]
    noisy, (weights, ratios) = posterior - missing, noise
    if not np.allclose(ratios, 1.0, rtol=1e-9):
        noisy = (weights * ratios) @ np.square(dense_or_sparse(matrix) @ covariance)
    return np.array([posterior, missing, noisy])


@dataclass(frozen=True)
class SmallFrame:
    """A frame with the edges of a larger one, whose maps are exact for noise that is even over a lens type."""

    like: Bands

    @cached_property
    def _matrices(self) -> list[sparse.csr_array]:
        """H of each lens type."""
        return [each.matrix(self.like.spectrum.shape, self.like.detail) for each in self.like.types]

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """H."""
        return sparse.csr_array(sparse.vstack(self._matrices, format="csr"))

    @cached_property
    def _moments(self) -> Moments:
        return moments(self.matrix, self.like.spectrum, self.like.detail)

    @cached_property
    def _parts(self) -> list[FloatArray]:
        """H^T H of each lens type where the unknowns are f's pixels: (N, N)."""
        return [gram(matrix) for matrix in self._matrices]

    @cached_property
    def _precision(self) -> FloatArray:
        return prior_precision(1 / self.like.spectrum, self.like.shape)

    def maps(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the three maps, (3, rows, columns), for all weights times `level`.

        ratios : of the actual to the expected noise of each lens type
        """
        like, of_types = self.like, level * np.array(self.like.weights)
        weights, every = (self.of_readings(each) for each in (of_types, np.array(ratios)))
        if like.detail > 1:
            return self._moments.variances(1 / weights, every / weights, like.shape)
        parts = (weight * part for part, weight in zip(self._parts, of_types, strict=True))
        precision, pixels = sum(parts, self._precision), np.arange(like.spectrum.size)
        found = dense_maps(self.matrix, (weights, every), precision, 1 / like.spectrum, pixels)
        return found.reshape(3, *like.shape)

    def of_readings(self, of_types: FloatArray) -> FloatArray:
        """Return the value of each reading's lens type: (readings,)."""
        return np.repeat(of_types, [matrix.shape[0] for matrix in self._matrices])


@dataclass(frozen=True)
class Interior:
    """Pixels that are far from the edges of a frame: its maps as a sum over frames of reflecting edges.

    Such edges raise the mean of a map by a part that falls with 1 / n, the number of lines, which n and 2 n show.
    """

    parts: list[tuple[float, Bands]]

    @classmethod
    def of(cls, task: EstimationTask, bands: Bands, axes: tuple[int, ...] = (0, 1)) -> Interior:
        """Return that of a task's frame; axes : along which it is to have no edges."""
        sizes = [
            [(2 * GRID, 2.0), (GRID, -1.0)] if axis in axes else [(size, 1.0)] for axis, size in enumerate(bands.shape)
        ]
        return cls(
            [(one * two, _with_shape(bands, task, (rows, columns))) for (rows, one), (columns, two) in product(*sizes)]
        )

    def variances(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the three maps' value for all weights times `level`: (3,)."""
        total = sum((share * np.array(like.variances(level, ratios)) for share, like in self.parts), np.zeros(3))
        return _positive(total)


def _positive(maps: FloatArray) -> FloatArray:
    """Return three maps whose parts by prior and noise are no less than their rounding: (3,)."""
    return np.maximum(maps, max(LEAST * float(maps[0]), np.finfo(float).tiny))


class Edges:
    """Ratios of a frame's maps to those far from its edges, by strips from edge to edge and a small frame at corners.

    A strip has edges along one axis alone. Where two edges meet, the product of both strips' ratios is corrected by
    what a small frame shows in place of that of strips of its size.
    """

    def __init__(self, task: EstimationTask, bands: Bands, *, quick: bool = False) -> None:
        """Prepare the strips and the small frame of a task's frame; quick : True where its mean alone matters."""
        most = max(LINES // task.finer**2, LEAST_LINES)
        side = FINE_SIDE if task.finer > 1 else QUICK_SIDE if quick else SIDE
        self.shape = bands.shape
        self.near = min(bands.shape[0], side), min(bands.shape[1], side)
        self._interior, self._corners = Interior.of(task, bands), SmallFrame(_with_shape(bands, task, self.near))
        self._strips: dict[tuple[int, int], tuple[Bands, Interior]] = {}
        for axis, size in (*enumerate(self.shape), *enumerate(self.near)):
            shape = (min(size, most), ALONG) if axis == 0 else (ALONG, min(size, most))
            like = _with_shape(bands, task, shape)
            self._strips[axis, size] = like, Interior.of(task, like, (axis,))

    def ratios(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the ratios of the three maps for all weights times `level`: (3, rows, columns)."""
        small = self._corners.maps(level, ratios) / self._interior.variances(level, ratios)[:, None, None]
        strips = self._product(self.near, level, ratios)
        small = np.divide(small, strips, out=np.ones_like(small), where=strips > 0)  # 0 of noise where none counts
        return self._product(self.shape, level, ratios) * _in_corners(small, self.shape)

    def _product(self, shape: tuple[int, int], level: float, ratios: tuple[float, ...]) -> FloatArray:
        down, right = (self._across(axis, size, level, ratios) for axis, size in enumerate(shape))
        return down[:, :, None] * right[:, None, :]

    def _across(self, axis: int, size: int, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the ratios of lines between two edges that are `size` lines apart: (3, size)."""
        like, interior = self._strips[axis, size]
        lines = like.variances_across(axis, level, ratios)
        count = lines.shape[1]
        middle = interior.variances(level, ratios) if count == size else lines[:, count // 2]
        return lines[:, _small_index(size, count)] / _positive(middle)[:, None]


def _in_corners(small: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the quarters of a small frame's maps at the corners of a large one, 1 elsewhere: (3, rows, columns)."""
    total = np.ones((3, *shape))
    down, right = (_ends(*sizes) for sizes in zip(shape, small.shape[1:], strict=True))
    for (rows, of_rows), (columns, of_columns) in product(down, right):
        total[:, rows, columns] = small[:, of_rows, of_columns]
    return total


def _ends(size: int, side: int) -> list[tuple[slice, slice]]:
    """Return the ends of an axis of `size` pixels and those of one of `side`."""
    near, far = side // 2, side - side // 2
    return [(slice(0, near), slice(0, near)), (slice(size - far, size), slice(side - far, side))]


@dataclass(frozen=True)
class SmallFrames:
    """Ratios of a frame whose errors reach from edge to edge, by small ones with the same edges.

    Where lens types leave a null space, no lens type sees some waves. An edge has as many of them in a frame of any
    length n, so that their part in a variance falls with 1 / n, which two lengths show.
    """

    shape: tuple[int, int]
    parts: list[tuple[float, SmallFrame]]
    interior: Interior

    @classmethod
    def of(cls, task: EstimationTask, bands: Bands) -> SmallFrames:
        """Return those of a task's frame."""
        lengths = product(*map(_lengths, bands.shape))
        parts = [(one * two, _with_shape(bands, task, (down, across))) for (down, one), (across, two) in lengths]
        return cls(bands.shape, [(share, SmallFrame(like)) for share, like in parts], Interior.of(task, bands))

    def ratios(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the ratios of the three maps for all weights times `level`: (3, rows, columns)."""
        found = [
            np.stack([_enlarged(each, self.shape) for each in small.maps(level, ratios)]) for _, small in self.parts
        ]
        total = sum((share * each for (share, _), each in zip(self.parts, found, strict=True)), np.zeros_like(found[0]))
        return np.maximum(total, LEAST_SHARE * found[0]) / self.interior.variances(level, ratios)[:, None, None]


@dataclass(frozen=True)
class Strips:
    """Maps of a frame of independent pixels from strips along its edges, as long as these.

    Along an edge that some lens types do not see, errors reach to its ends. Pixels beside a strip count as known, so
    that at a corner the larger one of two variances is the more accurate one. The middle of a strip represents any
    interior.

    along : frames of twice the depth of a strip, with left and right edges, then with those at the top and the bottom
    """

    shape: tuple[int, int]
    prior: float
    along: tuple[SmallFrame, SmallFrame]
    interior: Interior

    @classmethod
    def of(cls, task: EstimationTask, bands: Bands, prior: float) -> Strips:
        """Return those of a task's frame; prior : 1 / P0."""
        deep = DEEP * max(max(each.extent) for each in bands.types)
        rows, columns = bands.shape
        left, top = (rows, min(2 * deep, columns)), (min(2 * deep, rows), columns)
        along = tuple(SmallFrame(_with_shape(bands, task, each)) for each in (left, top))
        return cls(bands.shape, prior, (along[0], along[1]), Interior.of(task, bands))

    def ratios(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the ratios of the three maps for all weights times `level`: (3, rows, columns)."""
        total = np.zeros((3, *self.shape))
        for axis, frame in zip((1, 0), self.along, strict=True):
            size, wide = self.shape[axis], frame.like.shape[axis]
            deep = wide if wide == size else wide // 2
            half = size if deep == size else deep // 2
            view = total if axis == 1 else total.swapaxes(1, 2)
            for first in {0, wide - deep}:
                part = self._strip(frame, level, ratios, axis, slice(first, first + deep))
                kept = part[:, :, :half] if first == 0 else part[:, :, deep - half :]
                place = view[:, :, :half] if first == 0 else view[:, :, size - half :]
                np.copyto(place, kept, where=kept[0] > place[0])
        middle = total[:, self.shape[0] // 2, min(self.along[0].like.shape[1] // 4 - 1, self.shape[1] // 2)]
        total = np.where(total[0] > 0, total, middle[:, None, None])
        return total / self.interior.variances(level, ratios)[:, None, None]

    def _strip(self, frame: SmallFrame, level: float, ratios: tuple[float, ...], axis: int, lines: slice) -> FloatArray:
        """Return the maps of lines of a frame along its edge: (3, length, depth)."""
        numbers = np.arange(frame.like.shape[0] * frame.like.shape[1]).reshape(frame.like.shape)
        pixels = (numbers if axis == 1 else numbers.T)[:, lines]
        matrix = frame.matrix[:, pixels.ravel()]
        weights, every = (frame.of_readings(np.array(each)) for each in (frame.like.weights, ratios))
        reach = max(max(each.extent) for each in frame.like.types)
        return swept_maps(matrix, level * weights, every, self.prior, pixels.shape, reach)


def frame_map(
    task: EstimationTask, bands: Bands, ratios: tuple[float, ...], level: FloatArray, way: Way, *, quick: bool = False
) -> VarianceMap:
    """Return the map of a frame whose lens types see the same everywhere, as `bands` do.

    ratios : as of `mean_ratios`;  level : logarithms of the weights of each pixel's measurements over their means, (N,)
    way : to the ratios near the edges, one of `ways_to_edges`;  quick : True where the mean of the map alone matters
    """
    shape = bands.shape
    interior = Interior.of(task, bands)
    edges: Edges | SmallFrames | Strips
    if way == "edges":
        edges = Edges(task, bands, quick=quick)
    elif way == "far":
        edges = SmallFrames.of(task, bands)
    else:
        edges = Strips.of(task, bands, 1 / task.prior.variance)

    def inside(value: float) -> FloatArray:
        return np.broadcast_to(interior.variances(float(np.exp(value)), ratios)[:, None, None], (3, *shape))

    def at_edges(value: float) -> FloatArray:
        return edges.ratios(float(np.exp(value)), ratios)

    return by_levels(level.reshape(shape), inside, at_edges)


def ways_to_edges(task: EstimationTask, bands: Bands) -> list[Way]:
    """Return the ways to the ratios near the edges, the faster one first, where the better one depends on the noise.

    Errors reach from edge to edge where lens types leave a null space, and may along edges that some do not see; those
    of independent pixels do so undamped.
    """
    null_space = task.finer == 1 and leaves_null_space(task.model.camera)
    if null_space and task.prior.kind == "independent":
        return ["far"]
    far: list[Way] = ["far"] if task.finer == 1 and (null_space or _leaves_corner(bands)) else []
    return ["swept" if is_narrow(task) else "edges", *far]


def is_narrow(task: EstimationTask) -> bool:
    """Return True if K couples near pixels alone: independent pixels, which sharp lenses see."""
    return task.finer == 1 and task.prior.kind == "independent" and task.model.camera.has_sharp_footprints


def _leaves_corner(bands: Bands) -> bool:
    """Return True if two edges meet that some lens types do not see."""

    def leaves_edge(axis: int) -> bool:
        firsts = [each.first[axis] for each in bands.types]
        lengths = [bands.detail * (each.count[axis] - 1) + each.extent[axis] for each in bands.types]
        return max(firsts) > 0 or min(map(sum, zip(firsts, lengths, strict=True))) < bands.spectrum.shape[axis]

    return leaves_edge(0) and leaves_edge(1)


def _with_shape(bands: Bands, task: EstimationTask, shape: tuple[int, int]) -> Bands:
    """Return the bands of a smaller frame with the same edges."""
    by = bands.shape[0] - shape[0], bands.shape[1] - shape[1]
    fine = shape[0] * bands.detail, shape[1] * bands.detail
    spectrum = np.broadcast_to(1 / np.asarray(task.precision_on(fine)), fine)
    types = tuple(each.shortened(by) for each in bands.types)
    return replace(bands, shape=shape, spectrum=spectrum, types=types, scale=1.0)


def _lengths(size: int) -> list[tuple[int, float]]:
    """Return the sides of small frames along an axis and their shares in the variances of the large one."""
    if size <= LONG:
        return [(size, 1.0)]
    share = (1 / size - 1 / LONG) / (1 / SHORT - 1 / LONG)
    return [(LONG, 1 - share), (SHORT, share)]


def by_levels(level: FloatArray, inside: Maps, edges: Maps) -> VarianceMap:
    """Return the map of pixels at levels of the noise, logarithms, (rows, columns).

    inside, edges : from a level to the three maps of a frame without edges, and to the ratios of those with edges
    """
    pairs = zip(between(level, INTERIOR, EVEN, inside), between(level, EDGES, EVEN_EDGES, edges), strict=True)
    return VarianceMap(*(one * other for one, other in pairs))


def between(level: FloatArray, most: int, even: float, maps: Maps) -> list[FloatArray]:
    """Return maps at each pixel's level, between those of at most `most` levels, whose logarithms are interpolated.

    even : range of levels that count as one
    """
    low, high = float(level.min()), float(level.max())
    if high - low <= even:
        return list(maps((low + high) / 2))
    count = min(most, 2 + int((high - low) * most))
    values = np.linspace(low, high, count)
    place = (level - low) / (high - low) * (count - 1)
    total: list[FloatArray] = []
    tiny = np.finfo(float).tiny
    for number, value in enumerate(values):
        share = np.maximum(1 - np.abs(place - number), 0.0)
        parts = [share * np.log(np.maximum(each, tiny)) for each in maps(float(value))]
        total = parts if not total else [one + part for one, part in zip(total, parts, strict=True)]
    return [np.exp(each) for each in total]


def mean_ratios(task: EstimationTask, weights: FloatArray, actual: FloatArray) -> tuple[float, ...]:
    """Return the ratio of the actual to the expected noise of each lens type, weighted as the estimator weighs it."""
    ratios = task.on_all_measurements(actual / task.expected_noise, 0.0)
    parts = [(weights[part], ratios[part]) for part in task.model.camera.type_slices()]
    return tuple(float(np.mean(weight * ratio)) / (float(weight.mean()) or 1.0) for weight, ratio in parts)


def _enlarged(variance: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the map of a small frame for a frame of `shape`."""
    return variance[np.ix_(*(_small_index(*sizes) for sizes in zip(shape, variance.shape, strict=True)))]


def _small_index(size: int, side: int) -> NDArray[np.intp]:
    """Index, on an axis of `side` pixels, of each of `size`: equally far from the nearer edge, or in the middle."""
    index = np.arange(size)
    return index if side >= size else np.where(index < side // 2, index, np.maximum(side - (size - index), side // 2))
