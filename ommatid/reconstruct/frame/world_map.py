"""The expected error (Eq. 5) of f's pixels in front of a finer world, or where lens types do not see alike everywhere.

Of few pixels the covariances of f and of the readings are matrices, and the map is exact. Of a shift-invariant frame
the value far from the edges is that of the transfer functions for the noise of the measurements near a pixel, and a
small frame with the same edges shows how much larger it is near them. Of any other frame windows side by side, each
with a halo, give the maps: what readings see beside their window counts as noise. Exact solutions for random pixels say
how wrong the map is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, partial

import numpy as np
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Entries, Observation

from ..methods.method import EstimationTask
from ..prior import averaged_spectrum, cosine_waves
from ..problem import is_dense
from .bands import Bands
from .variance_map import VarianceMap, enlarged, precision_map, prior_precision

SIDE = 30  # pixels of f of a small frame
MOST_READINGS = 3600  # of an image whose map is exact
COLUMNS = 128  # readings whose covariances are computed at once
WINDOW, HALO, WINDOWS = 28, 8, 3  # pixels of f of a window and around its core; windows along each axis
CORE = 12  # pixels of f whose variances a window gives where the lens types do not see the same everywhere
INTERIOR, EDGES = 9, 4  # levels of noise at which the two are computed; others follow from them
EVEN, EVEN_EDGES = 1e-3, 0.1  # range of levels, logarithms, that count as one
VARYING = 0.05  # variation of kernels from which windows count it; one of 0.09 makes a map 11 % wrong
LEAST_LEVEL = 1e-3  # of the weights of a pixel's measurements, relative to their mean


Maps = Callable[[float], Sequence[FloatArray] | FloatArray]  # from the logarithm of a level to three maps


@dataclass(frozen=True)
class Moments:
    """Prior covariances of f's pixels and the readings: (N,) diagonal, (N, M) of both, (M, M) of the readings."""

    pixels: FloatArray
    both: FloatArray
    readings: FloatArray

    def variances(self, expected: FloatArray, actual: FloatArray, shape: tuple[int, int]) -> VarianceMap:
        """Return the map for readings with these noise variances, (M,)."""
        covariance = self.readings + np.diag(expected)
        factor = linalg.cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
        gain = np.asarray(linalg.cho_solve(factor, self.both.T, check_finite=False)).T
        posterior = self.pixels - np.einsum("ij,ij->i", gain, self.both)
        squares = np.square(gain)
        missing = np.maximum(posterior - squares @ expected, 0.0)
        return VarianceMap(
            np.maximum(posterior, 0.0).reshape(shape), missing.reshape(shape), (squares @ actual).reshape(shape)
        )


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


def world_of(image: FloatArray, spectrum: FloatArray, detail: int) -> FloatArray:
    """Return the likeliest world less its mean, P A^T (A P A^T)^-1 f, of an image, (rows, columns), less its mean."""
    waves = np.asarray(fft.dctn(image, 2, norm="ortho")) / averaged_spectrum(spectrum, detail)
    averages = np.kron(np.asarray(fft.idctn(waves, 2, norm="ortho")), np.full((detail, detail), detail**-2.0))
    spread = np.asarray(fft.dctn(averages, 2, norm="ortho")) * spectrum
    return np.asarray(fft.idctn(spread, 2, norm="ortho")).ravel()


def is_invariant(task: EstimationTask) -> bool:
    """Return True if every lens type sees the same everywhere: m x m sub-imagers one pixel of f apart, as designed."""
    camera = task.model.camera
    return camera.tolerance is None and all(each.finer(Fraction(1, task.finer)).is_sliding for each in camera.types)


def world_map(
    task: EstimationTask,
    observation: Observation,
    weights: FloatArray,
    bands: Bands,
    actual: FloatArray,
    halo: int = HALO,
) -> tuple[VarianceMap, FloatArray | float, bool]:
    """Return the map of Eq. 5, the prior variance of f's pixels, and True if the map is exact.

    observation, weights, bands : of the frame's system;  actual : (measurements used,) noise
    halo : of windows, pixels of f
    """
    if actual.size <= MOST_READINGS and max(task.shape_of_f) <= SIDE + SIDE // 2:
        exact = moments(task.model.to_sparse()[task.used], bands.spectrum, task.finer)
        return exact.variances(task.expected_noise, actual, task.shape_of_f), exact.pixels, True
    if not is_invariant(task):
        rows, columns = (min(CORE + 2 * halo, size) for size in task.shape_of_f)
        beside = bands.variances(1.0, mean_ratios(task, weights, actual))[0]
        return Windows(task, actual, (rows, columns), beside).frame(observation, halo), bands.prior_variance, False
    level = np.log(levels(task, observation, weights))
    variances = _frame_map(bands, task, mean_ratios(task, weights, actual), level)
    if any(isinstance(part, KernelFootprints) and part.variation > VARYING for part in observation.parts):
        variances = by_windows(variances, task, observation, actual)
    return variances, bands.prior_variance, False


@dataclass(frozen=True)
class Windows:
    """Maps of windows of a frame from the readings whose middles lie in them.

    actual : (measurements used,) noise;  shape : pixels of f of a window
    beside : variance of a pixel beside a window, of which its readings see some
    """

    task: EstimationTask
    actual: FloatArray
    shape: tuple[int, int]
    beside: float = 0.0

    def map(self, observation: Observation, corner: tuple[int, int]) -> FloatArray:
        """Return the three maps of the window that begins at `corner`, imaged by `observation`: (3, *shape)."""
        task, shape = self.task, self.shape
        pairs = zip(corner, shape, strict=True)
        rows, columns = (slice(first * task.finer, (first + side) * task.finer) for first, side in pairs)
        numbers = self._numbers(rows, columns)
        index = task.among_used(numbers)
        matrix = observation.rows_on(numbers, rows, columns)
        expected, actual = task.expected_noise[index], self.actual[index]
        if self.beside:
            lost = self._seen[numbers] - np.asarray(matrix.sum(axis=1)).ravel()
            expected, actual = (each + self.beside * np.square(lost) for each in (expected, actual))
        if task.finer > 1:
            found = moments(matrix, self._spectrum, task.finer).variances(expected, actual, shape)
            return np.array([found.posterior, found.missing, found.noisy])
        precision, excess = _information(matrix, 1 / expected) + self._precision, None
        if not np.allclose(actual, expected, rtol=1e-9):
            excess = _information(matrix, actual / expected**2 - 1 / expected)
        return precision_map(precision, 1 / self._spectrum, shape, 1.0, excess)

    def frame(self, observation: Observation, halo: int) -> VarianceMap:
        """Return the maps of a whole frame from windows side by side, without `halo` pixels around their middles."""
        observation = Observation(self.task.shape, (Entries(observation.to_sparse(), self.task.shape),))
        starts = [range(0, size, CORE) for size in self.task.shape_of_f]
        places = [(row, column) for row in starts[0] for column in starts[1]]
        last = [size - side for size, side in zip(self.task.shape_of_f, self.shape, strict=True)]
        corners = [(min(max(row - halo, 0), last[0]), min(max(column - halo, 0), last[1])) for row, column in places]
        total = np.empty((3, *self.task.shape_of_f))
        with one_thread(), ThreadPoolExecutor(processors()) as threads:
            found = threads.map(partial(self.map, observation), corners)
            for (row, column), (top, left), maps in zip(places, corners, found, strict=True):
                core = maps[:, row - top : row - top + CORE, column - left : column - left + CORE]
                total[:, row : row + core.shape[1], column : column + core.shape[2]] = core
        return VarianceMap(*total)

    def _numbers(self, rows: slice, columns: slice) -> IntArray:
        """Return the measurements used whose middles lie in a window, in ascending order."""
        order, down = self._by_row
        near = order[np.searchsorted(down, rows.start, "right") : np.searchsorted(down, rows.stop)]
        across = self.task.model.camera.middles[1][near]
        return np.sort(near[(across > columns.start) & (across < columns.stop) & self.task.used[near]])

    @cached_property
    def _by_row(self) -> tuple[IntArray, FloatArray]:
        """The measurements in the order of the rows of their middles, and these rows: (M,) each."""
        down = self.task.model.camera.middles[0]
        order = np.argsort(down, kind="stable")
        return order, down[order]

    @cached_property
    def _seen(self) -> FloatArray:
        """Light of an even image in each measurement: (M,)."""
        return self.task.model.applied.forward(np.ones(self.task.model.unknowns))

    @cached_property
    def _spectrum(self) -> FloatArray:
        shape = self.shape[0] * self.task.finer, self.shape[1] * self.task.finer
        return np.broadcast_to(1 / np.asarray(self.task.precision_on(shape)), shape)

    @cached_property
    def _precision(self) -> FloatArray:
        return prior_precision(1 / self._spectrum, self.shape)


def _information(matrix: sparse.csr_array, weights: FloatArray) -> FloatArray:
    """Return H^T diag(w) H of few pixels: (N, N)."""
    weighted = sparse.csr_array(matrix.multiply(weights[:, None]))
    if is_dense(matrix):
        return np.asarray(matrix.toarray().T @ weighted.toarray(), dtype=np.float64)
    return np.asarray((matrix.T @ weighted).toarray(), dtype=np.float64)


def by_windows(
    variances: VarianceMap, task: EstimationTask, observation: Observation, actual: FloatArray
) -> VarianceMap:
    """Return the map of a camera whose kernels vary over the field from that of their means.

    Their ratios are those of windows that are imaged by either, from the same readings, and linear between these.
    """
    shape = task.shape_of_f
    side = min(WINDOW, *shape)
    starts = [np.unique(np.linspace(0, size - side, WINDOWS).round().astype(int)) for size in shape]
    parts = [part.mean if isinstance(part, KernelFootprints) else part for part in observation.parts]
    like = Observation(observation.shape, tuple(parts))
    windows = Windows(task, actual, (side, side))
    ratios = np.ones((3, len(starts[0]), len(starts[1])))
    for row, column in np.ndindex(ratios.shape[1:]):
        corner = int(starts[0][row]), int(starts[1][column])
        core = tuple(
            slice(0 if first == 0 else HALO, side if first + side == size else side - HALO)
            for first, size in zip(corner, shape, strict=True)
        )
        found, other = (
            windows.map(each, corner)[(slice(None), *core)].mean(axis=(1, 2)) for each in (observation, like)
        )
        ratios[:, row, column] = np.divide(found, other, out=np.ones(3), where=other > 0)
    middles = [each + side / 2 for each in starts]
    down, across = (_interpolation(size, middle) for size, middle in zip(shape, middles, strict=True))
    whole = [down @ each @ across.T for each in ratios]
    return VarianceMap(variances.posterior * whole[0], variances.missing * whole[1], variances.noisy * whole[2])


def _interpolation(size: int, nodes: FloatArray) -> FloatArray:
    """Return the matrix from values at nodes of an axis to its pixels, constant beyond the nodes: (size, nodes)."""
    return np.stack([np.interp(np.arange(size) + 0.5, nodes, unit) for unit in np.eye(nodes.size)], axis=1)


def _frame_map(bands: Bands, task: EstimationTask, ratios: tuple[float, ...], level: FloatArray) -> VarianceMap:
    """Return the map from the levels of the noise, logarithms, (rows, columns)."""
    small = min(SIDE, bands.shape[0]), min(SIDE, bands.shape[1])
    by = bands.shape[0] - small[0], bands.shape[1] - small[1]
    types = [each.shortened(by) for each in bands.types]
    fine = small[0] * bands.detail, small[1] * bands.detail
    matrix = sparse.csr_array(sparse.vstack([each.matrix(fine, bands.detail) for each in types], format="csr"))
    spectrum = 1 / np.asarray(task.precision_on(fine))
    known = moments(matrix, spectrum, bands.detail)
    sizes = [each.count[0] * each.count[1] for each in types]
    even = replace(bands, shape=small, spectrum=spectrum, types=tuple(types), scale=1.0)

    def inside(value: float) -> list[FloatArray]:
        return [np.full(bands.shape, each) for each in bands.variances(float(np.exp(value)), ratios)]

    def edges(value: float) -> list[FloatArray]:
        weights, level = np.exp(value) * np.repeat(bands.weights, sizes), float(np.exp(value))
        found = known.variances(1 / weights, np.repeat(ratios, sizes) / weights, small)
        maps = zip((found.posterior, found.missing, found.noisy), even.variances(level, ratios), strict=True)
        return [enlarged(each / max(mean, np.finfo(float).tiny), bands.shape) for each, mean in maps]

    return by_levels(level, inside, edges)


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


def levels(task: EstimationTask, observation: Observation, weights: FloatArray) -> FloatArray:
    """Return the weights of each pixel's measurements relative to the means of their lens types: (rows, columns)."""
    means = np.empty_like(weights)
    for part in task.model.camera.type_slices():
        means[part] = weights[part].mean()
    local, average = (task.of_f(observation.adjoint(values)) for values in (weights, means))
    relative = np.divide(local, average, out=np.ones_like(local), where=average > 0)
    return np.maximum(relative, LEAST_LEVEL).reshape(task.shape_of_f)


def mean_ratios(task: EstimationTask, weights: FloatArray, actual: FloatArray) -> tuple[float, ...]:
    """Return the ratio of the actual to the expected noise of each lens type, weighted as the estimator weighs it."""
    ratios = task.on_all_measurements(actual / task.expected_noise, 0.0)
    parts = [(weights[part], ratios[part]) for part in task.model.camera.type_slices()]
    return tuple(float(np.mean(weight * ratio)) / (float(weight.mean()) or 1.0) for weight, ratio in parts)
