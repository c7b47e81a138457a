"""The expected error (Eq. 5) of f's pixels from windows of a frame side by side, for any camera and any noise.

Each window has a halo, and its own readings: what these see beside it counts as noise.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from math import ceil

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Entries, Observation

from ..methods.method import EstimationTask
from .bands import Bands
from .swept import swept_maps
from .variance_map import (
    VarianceMap,
    columns_of_covariance,
    dense_or_sparse,
    information,
    is_narrow,
    mean_ratios,
    moments,
    prior_precision,
    without_edges,
)

CORE = 12  # pixels of f along a side of the core whose variances a window gives
HALOS = 8, 12, 16  # pixels of f around it, of which a longer one takes several times as long
MOST_ENTRIES = 30_000_000  # of H of a part, of which windows are then cut out of a matrix
SWEPT, LENGTH, BOXES = 24, 216, 4  # the same where pixels are independent: core, its other side, and halo in boxes
SIDE, WINDOWS = 28, 3  # pixels of f of a window that shows what the variation of kernels does; windows along each axis
Core = tuple[slice, ...]
WHOLE = slice(None), slice(None)
VARYING = 0.05  # variation of kernels from which windows count it; one of 0.09 makes a map 11 % wrong


@dataclass(frozen=True)
class Windows:
    """Maps of windows of a frame from the readings whose middles lie in them.

    actual : (measurements used,) noise;  core, halo : pixels of f of a window and around them
    beside : variance of a pixel beside a window, of which its readings see some
    """

    task: EstimationTask
    actual: FloatArray
    core: tuple[int, int]
    halo: int = 0
    beside: float = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels of f of a window with its halo."""
        rows, columns = (
            min(core + 2 * self.halo, size) for core, size in zip(self.core, self.task.shape_of_f, strict=True)
        )
        return rows, columns

    def map(self, observation: Observation, corner: tuple[int, int], core: Core = WHOLE) -> FloatArray:
        """Return the three maps of the core of the window that begins at `corner`, imaged by `observation`.

        core : slices of the window's rows and columns;  result : (3, rows, columns) of the core
        """
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
        kept = np.arange(shape[0] * shape[1]).reshape(shape)[core]
        if task.finer > 1:
            return moments(matrix, self._spectrum, task.finer).at(kept.ravel()).variances(expected, actual, kept.shape)
        if isinstance(self._prior, float) and is_narrow(task):
            ratios, reach = actual / expected, min(observation.reach, max(shape))
            return swept_maps(matrix, 1 / expected, ratios, self._prior, shape, reach)[:, *core]
        applied = dense_or_sparse(matrix)
        precision = information(applied, 1 / expected) + self._precision
        covariance, missing = columns_of_covariance(precision, 1 / self._spectrum, shape, kept.ravel())
        posterior = covariance[kept.ravel(), np.arange(kept.size)]
        noisy = posterior - missing
        if not np.allclose(actual, expected, rtol=1e-9):
            noisy = (actual / expected**2) @ np.square(applied @ covariance)
        return np.array([posterior, missing, noisy]).reshape(3, *kept.shape)

    def frame(self, observation: Observation) -> VarianceMap:
        """Return the maps of a whole frame from the cores of windows side by side."""
        parts = [
            part if part.entries > MOST_ENTRIES else Entries(part.to_sparse(), part.shape) for part in observation.parts
        ]
        observation = Observation(observation.shape, tuple(parts))
        starts = [range(0, size, core) for size, core in zip(self.task.shape_of_f, self.core, strict=True)]
        places = [(row, column) for row in starts[0] for column in starts[1]]
        last = [size - side for size, side in zip(self.task.shape_of_f, self.shape, strict=True)]
        corners = [
            (min(max(row - self.halo, 0), last[0]), min(max(column - self.halo, 0), last[1])) for row, column in places
        ]
        cores = [
            tuple(
                slice(first - start, first - start + size) for first, start, size in zip(*each, self.core, strict=True)
            )
            for each in zip(places, corners, strict=True)
        ]
        total = np.empty((3, *self.task.shape_of_f))
        with one_thread(), ThreadPoolExecutor(processors()) as threads:
            found = threads.map(partial(self.map, observation), corners, cores)
            for (row, column), core in zip(places, found, strict=True):
                total[:, row : row + core.shape[1], column : column + core.shape[2]] = core
        return VarianceMap(*total)

    def _numbers(self, rows: slice, columns: slice) -> IntArray:
        """Return the measurements used whose middles lie in a window, or beyond an edge that it touches, ascending."""
        (top, bottom), (left, right) = (
            (part.start or -np.inf, part.stop if part.stop < size else np.inf)
            for part, size in zip((rows, columns), self.task.shape, strict=True)
        )
        order, down = self._by_row
        near = order[np.searchsorted(down, top, "right") : np.searchsorted(down, bottom)]
        across = self.task.model.camera.middles[1][near]
        return np.sort(near[(across > left) & (across < right) & self.task.used[near]])

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
    def _prior(self) -> float | FloatArray:
        """1 / P0 of independent pixels, or 1 / its spectrum in a window."""
        return self.task.precision_on((self.shape[0] * self.task.finer, self.shape[1] * self.task.finer))

    @property
    def _spectrum(self) -> FloatArray:
        shape = self.shape[0] * self.task.finer, self.shape[1] * self.task.finer
        return np.broadcast_to(1 / np.asarray(self._prior), shape)

    @cached_property
    def _precision(self) -> FloatArray:
        return prior_precision(1 / self._spectrum, self.shape)


def windows_map(task: EstimationTask, weights: FloatArray, bands: Bands, actual: FloatArray, halo: int) -> VarianceMap:
    """Return the map of a frame from windows with a halo.

    weights : (M,) 1 / Rv;  bands : of a camera like this one;  actual : (measurements used,) noise
    """
    beside = without_edges(task, bands).variances(1.0, mean_ratios(task, weights, actual))[0]
    core = (CORE, CORE)
    if is_narrow(task):
        widest = max(ceil(each.ratio) for each in task.model.camera.types)
        core, halo = (LENGTH, SWEPT), max(halo, BOXES * widest)
    return Windows(task, actual, core, halo, beside).frame(task.model.applied)


def by_windows(
    variances: VarianceMap, task: EstimationTask, observation: Observation, actual: FloatArray
) -> VarianceMap:
    """Return the map of a camera whose kernels vary over the field from that of their means.

    Their ratios are those of windows that are imaged by either, from the same readings, and linear between these.
    """
    shape = task.shape_of_f
    side = min(SIDE, *shape)
    starts = [np.unique(np.linspace(0, size - side, WINDOWS).round().astype(int)) for size in shape]
    parts = [part.mean if isinstance(part, KernelFootprints) else part for part in observation.parts]
    like = Observation(observation.shape, tuple(parts))
    windows = Windows(task, actual, (side, side))
    ratios = np.ones((3, len(starts[0]), len(starts[1])))
    for row, column in np.ndindex(ratios.shape[1:]):
        corner = int(starts[0][row]), int(starts[1][column])
        core = tuple(
            slice(0 if first == 0 else HALOS[0], side if first + side == size else side - HALOS[0])
            for first, size in zip(corner, shape, strict=True)
        )
        found, other = (windows.map(each, corner, core).mean(axis=(1, 2)) for each in (observation, like))
        ratios[:, row, column] = np.divide(found, other, out=np.ones(3), where=other > 0)
    middles = [each + side / 2 for each in starts]
    down, across = (_interpolation(size, middle) for size, middle in zip(shape, middles, strict=True))
    whole = [down @ each @ across.T for each in ratios]
    return VarianceMap(variances.posterior * whole[0], variances.missing * whole[1], variances.noisy * whole[2])


def _interpolation(size: int, nodes: FloatArray) -> FloatArray:
    """Return the matrix from values at nodes of an axis to its pixels, constant beyond the nodes: (size, nodes)."""
    return np.stack([np.interp(np.arange(size) + 0.5, nodes, unit) for unit in np.eye(nodes.size)], axis=1)
