"""The expected error (Eq. 5) of f's pixels where the unknowns are those of a world finer than f.

Of few pixels the covariances of f and of the readings are matrices, and the map is exact. Of a frame the value far from
the edges is that of the transfer functions for the noise of the measurements near a pixel, and a small frame with the
same edges shows how much larger it is near them. Exact solutions for random pixels say how wrong the map is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import processors
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Observation

from ..methods.method import EstimationTask
from ..prior import averaged_spectrum, cosine_waves
from ..problem import is_dense
from .bands import Bands
from .variance_map import VarianceMap, enlarged

SIDE = 30  # pixels of f of a small frame
MOST_READINGS = 3600  # of an image whose map is exact
COLUMNS = 128  # readings whose covariances are computed at once
WINDOW, HALO, WINDOWS = 28, 8, 3  # pixels of f of a window and around its core; windows along each axis
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


def world_map(
    task: EstimationTask, observation: Observation, weights: FloatArray, bands: Bands, actual: FloatArray
) -> tuple[VarianceMap, FloatArray | float, bool]:
    """Return the map of Eq. 5, the prior variance of f's pixels, and True if the map is exact.

    observation, weights, bands : of the frame's system;  actual : (measurements used,) noise
    """
    if actual.size <= MOST_READINGS and max(task.shape_of_f) <= SIDE + SIDE // 2:
        exact = moments(task.model.to_sparse()[task.used], bands.spectrum, task.finer)
        return exact.variances(task.expected_noise, actual, task.shape_of_f), exact.pixels, True
    level = np.log(levels(task, observation, weights))
    variances = _frame_map(bands, task, mean_ratios(task, weights, actual), level)
    if any(isinstance(part, KernelFootprints) and part.variation > VARYING for part in observation.parts):
        variances = by_windows(variances, task, observation, actual)
    return variances, bands.prior_variance, False


def by_windows(
    variances: VarianceMap, task: EstimationTask, observation: Observation, actual: FloatArray
) -> VarianceMap:
    """Return the map of a camera whose kernels vary over the field from that of their means.

    Their ratios are those of windows that are imaged by either, from the same readings, and linear between these.
    """
    shape, fine = task.shape_of_f, task.finer
    side = min(WINDOW, *shape)
    starts = [np.unique(np.linspace(0, size - side, WINDOWS).round().astype(int)) for size in shape]
    spectrum = 1 / np.asarray(task.precision_on((side * fine, side * fine)))
    parts = [part.mean if isinstance(part, KernelFootprints) else part for part in observation.parts]
    like = Observation(observation.shape, tuple(parts))
    middle_row, middle_column = task.model.camera.middles
    ratios = np.ones((3, len(starts[0]), len(starts[1])))
    for row, column in np.ndindex(ratios.shape[1:]):
        corner = int(starts[0][row]), int(starts[1][column])
        rows, columns = (slice(first * fine, (first + side) * fine) for first in corner)
        inside = (middle_row > rows.start) & (middle_row < rows.stop) & (middle_column > columns.start)
        numbers = np.flatnonzero(inside & (middle_column < columns.stop) & task.used)
        index = task.among_used(numbers)
        found, other = (
            moments(each.rows_on(numbers, rows, columns), spectrum, fine).variances(
                task.expected_noise[index], actual[index], (side, side)
            )
            for each in (observation, like)
        )
        core = tuple(
            slice(0 if first == 0 else HALO, side if first + side == size else side - HALO)
            for first, size in zip(corner, shape, strict=True)
        )
        for number, name in enumerate(("posterior", "missing", "noisy")):
            mean = float(getattr(other, name)[core].mean())
            ratios[number, row, column] = float(getattr(found, name)[core].mean()) / mean if mean else 1.0
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
