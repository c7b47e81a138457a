"""The expected error (Eq. 5) of every pixel of a frame whose lens types see the same everywhere.

Far from the edges it is that of the transfer functions for the noise of the measurements near a pixel. A small frame
with the same edges shows how much larger it is near them. Of few pixels the covariances are matrices, and the map is
exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import processors

from ..forms.cholesky import factorise_positive
from ..methods.method import EstimationTask
from ..prior import averaged_spectrum, cosine_waves
from ..problem import is_dense
from .bands import Bands
from .conjugate_gradients import FrameSystem, leaves_null_space
from .swept import swept_maps

SIDE, FINE_SIDE = 40, 30  # pixels of f of a small frame, and where the world is finer
LONG, SHORT = 60, 44  # of those from which the effect of the length follows
GRID = 256  # pixels of f along an axis of the frame without edges
DEEP = 9  # of a strip along an edge, in kernels; half of it is used
LEAST_SHARE = 0.1  # of a variance in the small frame, which that in a large one is at least
COLUMNS = 128  # readings whose covariances are computed at once
INTERIOR, EDGES = 9, 4  # levels of noise at which the two are computed; others follow from them
EVEN, EVEN_EDGES = 1e-3, 0.1  # range of levels, logarithms, that count as one

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

    def variances(self, expected: FloatArray, actual: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Return the three maps for readings with these noise variances, (M,): (3, rows, columns)."""
        covariance = self.readings + np.diag(expected)
        factor = linalg.cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
        gain = np.asarray(linalg.cho_solve(factor, self.both.T, check_finite=False)).T
        posterior = self.pixels - np.einsum("ij,ij->i", gain, self.both)
        squares = np.square(gain)
        missing = np.maximum(posterior - squares @ expected, 0.0)
        return np.array([np.maximum(posterior, 0.0), missing, squares @ actual]).reshape(3, *shape)


def moments(matrix: sparse.csr_array, spectrum: FloatArray, detail: int) -> Moments:
    """Return the covariances for H, (M, pixels of the world), and the prior's spectrum, (F rows, F columns)."""
    fine, shape = spectrum.shape, (spectrum.shape[0] // detail, spectrum.shape[1] // detail)
    count = matrix.shape[0]
    both, readings = np.empty((shape[0] * shape[1], count)), np.empty((count, count))
    product = matrix.toarray() if is_dense(matrix) else matrix
    for start in range(0, count, COLUMNS):
        part = slice(start, min(start + COLUMNS, count))
        waves = fft.dctn(matrix[part].toarray().reshape(-1, *fine), 2, axes=(1, 2), norm="ortho", workers=processors())
        waves *= spectrum
        spread = np.asarray(fft.idctn(waves, 2, axes=(1, 2), norm="ortho", workers=processors(), overwrite_x=True))
        means = spread.reshape(-1, shape[0], detail, shape[1], detail).mean(axis=(2, 4))
        both[:, part] = means.reshape(len(spread), -1).T
        readings[:, part] = product @ spread.reshape(len(spread), -1).T
    vertical, horizontal = (np.square(cosine_waves(size)) for size in shape)
    pixels = (vertical @ averaged_spectrum(spectrum, detail) @ horizontal.T).ravel()
    return Moments(pixels, both, (readings + readings.T) / 2)


def prior_precision(prior: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return P0^-1 of a small frame as a matrix, (N, N), from 1 / its spectrum under the DCT-II."""
    waves = np.kron(*(np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape))
    return np.asarray(waves.T @ (prior.ravel()[:, None] * waves), dtype=np.float64)


def columns_of_covariance(
    precision: FloatArray, prior: FloatArray, shape: tuple[int, int], pixels: NDArray[np.intp] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the columns of C = K^-1 of these pixels, (N, n), and the diagonal of C P0^-1 C at them, (n,).

    precision : (N, N) K of a small frame;  prior : 1 / its spectrum;  pixels : (n,) of few; None: all
    """
    factor, _ = factorise_positive(precision)
    if pixels is None or pixels.size == precision.shape[0]:
        columns = factor.inverse()
    else:
        units = np.zeros((precision.shape[0], pixels.size))
        units[pixels, np.arange(pixels.size)] = 1.0
        columns = factor.solve(units)
    waves = np.asarray(fft.dctn(columns.reshape(*shape, -1), 2, axes=(0, 1), norm="ortho"))
    return columns, np.einsum("rc,rcn->n", prior, np.square(waves))


def dense_or_sparse(matrix: sparse.csr_array) -> FloatArray | sparse.csr_array:
    """Return H in the form whose products are faster."""
    return matrix.toarray() if is_dense(matrix) else matrix


def information(applied: FloatArray | sparse.csr_array, weights: FloatArray) -> FloatArray:
    """Return H^T diag(w) H of few pixels, (N, N), from H by `dense_or_sparse`."""
    if isinstance(applied, np.ndarray):
        return np.asarray(applied.T @ (applied * weights[:, None]), dtype=np.float64)
    return np.asarray((applied.T @ sparse.csr_array(applied.multiply(weights[:, None]))).toarray(), dtype=np.float64)


@dataclass(frozen=True)
class SmallFrame:
    """A frame with the edges of a larger one, whose maps are exact for noise that is even over a lens type."""

    like: Bands

    @cached_property
    def matrices(self) -> list[sparse.csr_array]:
        """H of each lens type."""
        return [each.matrix(self.like.spectrum.shape, self.like.detail) for each in self.like.types]

    @cached_property
    def _moments(self) -> Moments:
        matrix = sparse.csr_array(sparse.vstack(self.matrices, format="csr"))
        return moments(matrix, self.like.spectrum, self.like.detail)

    @cached_property
    def _parts(self) -> list[FloatArray]:
        """H^T H of each lens type where the unknowns are f's pixels: (N, N)."""
        return [information(dense_or_sparse(matrix), np.ones(matrix.shape[0])) for matrix in self.matrices]

    @cached_property
    def _precision(self) -> FloatArray:
        return prior_precision(1 / self.like.spectrum, self.like.shape)

    def maps(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the three maps, (3, rows, columns), for all weights times `level`.

        ratios : of the actual to the expected noise of each lens type
        """
        like, weights = self.like, level * np.array(self.like.weights)
        if like.detail > 1:
            noise, every = 1 / self.of_readings(weights), self.of_readings(np.array(ratios))
            return self._moments.variances(noise, every * noise, like.shape)
        first, excess = ratios[0], None
        for part, weight, ratio in zip(self._parts, weights, ratios, strict=True):
            if not np.isclose(ratio, first, rtol=1e-12):
                excess = (ratio - first) * weight * part + (0.0 if excess is None else excess)
        parts = (weight * part for part, weight in zip(self._parts, weights, strict=True))
        covariance, missing = columns_of_covariance(sum(parts, self._precision), 1 / like.spectrum, like.shape)
        posterior = np.diagonal(covariance)
        noisy = first * (posterior - missing)
        if excess is not None:
            noisy += np.einsum("ij,ij->j", covariance, excess @ covariance)
        return np.array([posterior, missing, noisy]).reshape(3, *like.shape)

    def of_readings(self, of_types: FloatArray) -> FloatArray:
        """Return the value of each reading's lens type: (readings,)."""
        return np.repeat(of_types, [matrix.shape[0] for matrix in self.matrices])


@dataclass(frozen=True)
class SmallFrames:
    """Maps of a frame from small ones with the same edges, whose middle represents any interior.

    Where lens types leave a null space, errors of waves that these do not see reach from edge to edge. An edge has as
    many such waves in a frame of any length n, so that their part in a variance falls with 1 / n, which two lengths
    show.
    """

    shape: tuple[int, int]
    parts: list[tuple[float, SmallFrame]]

    @classmethod
    def of(cls, task: EstimationTask, bands: Bands, *, far: bool) -> SmallFrames:
        """Return those of a task's frame; far : True where errors reach from edge to edge."""
        side = LONG if far else FINE_SIDE if task.finer > 1 else SIDE
        lengths = product(*(_lengths(size, side, far=far) for size in bands.shape))
        parts = [(one * two, _with_shape(bands, task, (down, across))) for (down, one), (across, two) in lengths]
        return cls(bands.shape, [(share, SmallFrame(like)) for share, like in parts])

    def maps(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the three maps for all weights times `level`: (3, rows, columns)."""
        found = [
            np.stack([_enlarged(each, self.shape) for each in small.maps(level, ratios)]) for _, small in self.parts
        ]
        total = sum((share * each for (share, _), each in zip(self.parts, found, strict=True)), np.zeros_like(found[0]))
        return np.maximum(total, LEAST_SHARE * found[0])


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

    @classmethod
    def of(cls, task: EstimationTask, bands: Bands, prior: float) -> Strips:
        """Return those of a task's frame; prior : 1 / P0."""
        deep = DEEP * max(max(each.extent) for each in bands.types)
        rows, columns = bands.shape
        left, top = (rows, min(2 * deep, columns)), (min(2 * deep, rows), columns)
        along = tuple(SmallFrame(_with_shape(bands, task, each)) for each in (left, top))
        return cls(bands.shape, prior, (along[0], along[1]))

    def maps(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the three maps for all weights times `level`: (3, rows, columns)."""
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
        return np.where(total[0] > 0, total, middle[:, None, None])

    def _strip(self, frame: SmallFrame, level: float, ratios: tuple[float, ...], axis: int, lines: slice) -> FloatArray:
        """Return the maps of lines of a frame along its edge: (3, length, depth)."""
        numbers = np.arange(frame.like.shape[0] * frame.like.shape[1]).reshape(frame.like.shape)
        pixels = (numbers if axis == 1 else numbers.T)[:, lines]
        matrix = sparse.csr_array(sparse.vstack(frame.matrices, format="csr"))[:, pixels.ravel()]
        weights, every = (frame.of_readings(np.array(each)) for each in (frame.like.weights, ratios))
        reach = max(max(each.extent) for each in frame.like.types)
        return swept_maps(matrix, level * weights, every, self.prior, pixels.shape, reach)


def frame_map(task: EstimationTask, system: FrameSystem, bands: Bands, actual: FloatArray, *, far: bool) -> VarianceMap:
    """Return the map of a frame whose lens types see the same everywhere, as `bands` do.

    actual : (measurements used,) noise;  far : True where errors reach from edge to edge
    """
    ratios, shape = mean_ratios(task, system.weights, actual), bands.shape
    grid = without_edges(task, bands)
    if isinstance(system.prior, float) and is_narrow(task) and not far:
        even = Strips.of(task, bands, system.prior)
    else:
        even = SmallFrames.of(task, bands, far=far)

    def interior(value: float) -> FloatArray:
        return np.array(grid.variances(float(np.exp(value)), ratios))[:, None, None]

    def inside(value: float) -> FloatArray:
        return np.broadcast_to(interior(value), (3, *shape))

    def edges(value: float) -> FloatArray:
        return even.maps(float(np.exp(value)), ratios) / np.maximum(interior(value), np.finfo(float).tiny)

    return by_levels(np.log(system.levels(task.of_f)).reshape(shape), inside, edges)


def ways_to_edges(task: EstimationTask, bands: Bands) -> list[bool]:
    """Return whether errors reach from edge to edge; both, the faster one first, where that depends on the noise.

    They do where lens types leave a null space, and may along edges that some of them do not see.
    """
    if task.finer > 1 or leaves_null_space(task.model.camera):
        return [task.finer == 1]
    return [False] if is_narrow(task) or not unseen_corners(bands) else [False, True]


def is_narrow(task: EstimationTask) -> bool:
    """Return True if K couples near pixels alone: independent pixels, which sharp lenses see."""
    return task.finer == 1 and task.prior.kind == "independent" and task.model.camera.has_sharp_footprints


def unseen_corners(bands: Bands) -> list[tuple[int, int]]:
    """Return the corner pixels of f, (row, column), where two edges meet that some lens types do not see."""
    ends: list[list[int]] = []
    for axis, size in enumerate(bands.shape):
        seen = [(each.first[axis], bands.detail * (each.count[axis] - 1) + each.extent[axis]) for each in bands.types]
        unseen = any(first > 0 for first, _ in seen), any(sum(each) < size * bands.detail for each in seen)
        ends.append([place for place, missing in zip((0, size - 1), unseen, strict=True) if missing])
    return list(product(*ends))  # type: ignore[arg-type]


def is_uneven(task: EstimationTask, system: FrameSystem) -> bool:
    """Return True if the noise of neighbouring pixels differs."""
    return float(np.ptp(np.log(system.levels(task.of_f)))) > EVEN_EDGES


def without_edges(task: EstimationTask, bands: Bands) -> Bands:
    """Return bands of few enough waves for the variances of pixels far from the edges."""
    return _with_shape(bands, task, (min(GRID, bands.shape[0]), min(GRID, bands.shape[1])))


def _with_shape(bands: Bands, task: EstimationTask, shape: tuple[int, int]) -> Bands:
    """Return the bands of a smaller frame with the same edges."""
    by = bands.shape[0] - shape[0], bands.shape[1] - shape[1]
    fine = shape[0] * bands.detail, shape[1] * bands.detail
    spectrum = np.broadcast_to(1 / np.asarray(task.precision_on(fine)), fine)
    types = tuple(each.shortened(by) for each in bands.types)
    return replace(bands, shape=shape, spectrum=spectrum, types=types, scale=1.0)


def _lengths(size: int, side: int, *, far: bool) -> list[tuple[int, float]]:
    """Return the sides of small frames along an axis and their shares in the variances of the large one."""
    if not far or size <= side:
        return [(min(side, size), 1.0)]
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
