"""The expected error (Eq. 5) of f's pixels from windows of a frame side by side, for any camera and any noise.

Each window has a halo, and its own readings: what these see beside it counts as noise. Variances are too large by what
a longer halo would show. That depends on a pixel's place in its core, and hardly on the window: some windows with a
long halo correct all.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import ceil
from typing import NamedTuple

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Entries, Observation, ObservationPart

from ..methods.method import EstimationTask
from ..problem import gram
from .bands import Bands
from .swept import swept_maps
from .variance_map import (
    Interior,
    VarianceMap,
    dense_maps,
    is_narrow,
    mean_ratios,
    moments,
    prior_precision,
)

CORE = 12  # pixels of f along a side of the core whose variances a window gives
HALOS = 6, 8, 12, 16  # pixels of f around it: of many with even noise, of others, and where the map is rough
FEW = 200  # windows of a frame, below which the work of those that correct them counts
LONG_HALO, MEDIUM_HALO = 16, 12  # of windows that correct all others; where these are few, or the world is finer
INSIDE = 2, 1  # windows that correct all others, along an axis between those at the edges; likewise
MOST_ENTRIES = 40_000_000  # of H of a lens type, of which windows are then cut out of a matrix
SWEPT, LENGTH, BOXES = 24, 216, 4  # the same where pixels are independent: core, its other side, and halo in boxes
SIDE, FINE_SIDE = 28, 20  # pixels of f of a window that compares a camera with a map; with a camera, and a finer world
RIM = 0.3  # of such a window that lies beside its core, on either side
FEWEST, MOST = 3, 8  # such windows along an axis
Core = tuple[slice, ...]
WHOLE = slice(None), slice(None)
VARYING = 0.05  # variation of kernels from which windows count it; one of 0.09 makes a map 11 % wrong


class Stretch(NamedTuple):
    """Rows or columns of a window: the first of them in the frame, and its core among them."""

    first: int
    core: slice


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
        task, shape, numbers = self.task, self.shape, self._near(corner)
        numbers = numbers[task.used[numbers]]
        index, (matrix, beside) = task.among_used(numbers), self._cut(observation, corner, numbers)
        expected, actual = task.expected_noise[index] + beside, self.actual[index] + beside
        kept = np.arange(shape[0] * shape[1]).reshape(shape)[core]
        if task.finer > 1:
            return moments(matrix, self._spectrum, task.finer).at(kept.ravel()).variances(expected, actual, kept.shape)
        if isinstance(self._prior, float) and is_narrow(task):
            reach = min(observation.reach, max(shape))
            return swept_maps(matrix, 1 / expected, actual / expected, self._prior, shape, reach)[:, *core]
        noise, precision = (1 / expected, actual / expected), gram(matrix, 1 / expected) + self._precision
        return dense_maps(matrix, noise, precision, 1 / self._spectrum, kept.ravel()).reshape(3, *kept.shape)

    def frame(self, observation: Observation) -> VarianceMap:
        """Return the maps of a whole frame from the cores of windows side by side."""
        applied, (rows, columns) = self._as_matrices(observation), self._stretches

        def at(place: tuple[Stretch, Stretch]) -> FloatArray:
            return self.map(applied, (place[0].first, place[1].first), (place[0].core, place[1].core))

        with one_thread(), ThreadPoolExecutor(processors()) as threads:
            found = list(threads.map(at, product(rows, columns)))
            if self.halo < self._longer.halo and not is_narrow(self.task):
                found = list(map(np.multiply, found, self._by_longer_halo(applied, threads)))
        lines = [found[first : first + len(columns)] for first in range(0, len(found), len(columns))]
        return VarianceMap(*np.block(lines))

    @cached_property
    def _longer(self) -> Windows:
        """The windows with a long halo."""
        return replace(self, halo=MEDIUM_HALO if has_few_windows(self.task) else LONG_HALO)

    def _by_longer_halo(self, observation: Observation, threads: ThreadPoolExecutor) -> list[FloatArray]:
        """Return the ratios of maps with a long halo to those of the windows of a frame: (3, rows, columns) of each.

        They are medians over some windows inside the frame, over some at each of its edges, and those in its corners.
        """
        longer = self._longer
        pairs = [list(zip(*each, strict=True)) for each in zip(self._stretches, longer._stretches, strict=True)]
        chosen = [_by_edges(len(axis), INSIDE[has_few_windows(self.task)]) for axis in pairs]

        def ratio(row: int, column: int) -> FloatArray:
            own, wide = zip(pairs[0][row], pairs[1][column], strict=True)
            maps, corrected = (
                windows.map(observation, (down.first, across.first), (down.core, across.core))
                for windows, (down, across) in ((self, own), (longer, wide))
            )
            return np.divide(corrected, maps, out=np.ones_like(maps), where=maps > 0)

        places = sorted({place for down in chosen[0] for across in chosen[1] for place in product(down, across)})
        ratios = dict(zip(places, threads.map(ratio, *zip(*places, strict=True)), strict=True))
        return [
            np.median([ratios[place] for place in product(down, across)], axis=0) for down, across in product(*chosen)
        ]

    def _as_matrices(self, observation: Observation) -> Observation:
        """Return H with one matrix for each lens type of not too many entries: many parts are slow to cut."""
        found: list[ObservationPart] = []
        for place in self.task.model.camera.type_slices():
            pairs = zip(observation.parts, observation.slices, strict=True)
            own = [part for part, each in pairs if place.start <= each.start < place.stop]
            few = 0 < sum(part.entries for part in own) <= MOST_ENTRIES  # none where one part holds several types
            found += (
                [Entries(Observation(observation.shape, tuple(own)).to_sparse(), observation.shape)] if few else own
            )
        return Observation(observation.shape, tuple(found))

    @property
    def _stretches(self) -> list[list[Stretch]]:
        """Rows and columns of the windows of a frame, whose cores lie side by side."""
        found: list[list[Stretch]] = []
        for size, side, core in zip(self.task.shape_of_f, self.shape, self.core, strict=True):
            places = range(0, size, core)
            firsts = [min(max(place - self.halo, 0), size - side) for place in places]
            pairs = zip(places, firsts, strict=True)
            found.append(
                [Stretch(first, slice(place - first, min(place - first + core, side))) for place, first in pairs]
            )
        return found

    def _window(self, corner: tuple[int, int]) -> tuple[slice, slice]:
        """Return the rows and columns of the unknowns of the window that begins at a pixel of f."""
        pairs = zip(corner, self.shape, strict=True)
        rows, columns = (slice(first * self.task.finer, (first + side) * self.task.finer) for first, side in pairs)
        return rows, columns

    def _cut(
        self, observation: Observation, corner: tuple[int, int], numbers: IntArray
    ) -> tuple[sparse.csr_array, FloatArray]:
        """Return H of readings on a window, and the variance by what they see beside it: (m,)."""
        matrix = observation.rows_on(numbers, *self._window(corner))
        return matrix, self.beside * np.square(self._seen[numbers] - np.asarray(matrix.sum(axis=1)).ravel())

    def _near(self, corner: tuple[int, int]) -> IntArray:
        """Return the measurements whose middles lie in a window, or beyond an edge that it touches, ascending."""
        (top, bottom), (left, right) = (
            (part.start or -np.inf, part.stop if part.stop < size else np.inf)
            for part, size in zip(self._window(corner), self.task.shape, strict=True)
        )
        order, down = self._by_row
        near = order[np.searchsorted(down, top, "right") : np.searchsorted(down, bottom)]
        across = self.task.model.camera.middles[1][near]
        return np.sort(near[(across > left) & (across < right)])

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
    beside = float(Interior.of(task, bands).variances(1.0, mean_ratios(task, weights, actual))[0])
    core = (CORE, CORE)
    if is_narrow(task):
        widest = max(ceil(each.ratio) for each in task.model.camera.types)
        core, halo = (LENGTH, SWEPT), max(halo, BOXES * widest)
    return Windows(task, actual, core, halo, beside).frame(task.model.applied)


def has_few_windows(task: EstimationTask) -> bool:
    """Return True where a few windows with a long halo would be much of the work."""
    rows, columns = (ceil(size / CORE) for size in task.shape_of_f)
    return task.finer > 1 or rows * columns < FEW


def _by_edges(count: int, most: int) -> list[tuple[int, ...]]:
    """Return, for each of `count` windows along an axis, the numbers of those that stand for it: at most so many."""
    inside = tuple(np.linspace(0, count - 1, most + 2).round().astype(int)[1:-1].tolist())
    return [(number,) if number in (0, count - 1) else inside for number in range(count)]


def varies_over_field(observation: Observation) -> bool:
    """Return True if kernels vary over the field by more than the map of their means allows for."""
    return any(isinstance(part, KernelFootprints) and part.variation > VARYING for part in observation.parts)


def of_mean_kernels(observation: Observation) -> Observation:
    """Return the camera whose kernels are everywhere their means over the field."""
    parts = (part.mean if isinstance(part, KernelFootprints) else part for part in observation.parts)
    return Observation(observation.shape, tuple(parts))


def by_windows(
    variances: VarianceMap,
    task: EstimationTask,
    observation: Observation,
    actual: FloatArray,
    like: Observation | None = None,
) -> VarianceMap:
    """Return the map of a camera, `observation`, from that of a similar shift-invariant one, `variances`.

    Their ratios are those of some windows, and linear between these. The mean is right then, and single pixels as far
    as the cameras are alike.

    like : the similar camera, which windows compare from the same readings, so that their halos may be short; None:
        windows are compared with the map itself
    """
    shape, side = task.shape_of_f, min(FINE_SIDE if like and task.finer > 1 else SIDE, *task.shape_of_f)
    rim = round(RIM * side)
    windows = Windows(task, actual, (side, side), beside=0.0 if like else float(variances.posterior.mean()))
    axes: list[list[Stretch]] = []
    for size in shape:
        count = max(FEWEST, min(size // side, MOST))
        firsts = np.unique(np.linspace(0, size - side, count).round().astype(int)).tolist()
        ends = [(rim if first else 0, side - rim if first + side < size else side) for first in firsts]
        axes.append([Stretch(first, slice(*each)) for first, each in zip(firsts, ends, strict=True)])

    def ratio(place: tuple[Stretch, Stretch]) -> FloatArray:
        corner, core = (place[0].first, place[1].first), (place[0].core, place[1].core)
        if like:
            others = windows.map(like, corner, core)
        else:
            rows, columns = (slice(each.first + each.core.start, each.first + each.core.stop) for each in place)
            others = np.array([variances.posterior, variances.missing, variances.noisy])[:, rows, columns]
        found, other = (maps.mean(axis=(1, 2)) for maps in (windows.map(observation, corner, core), others))
        return np.divide(found, other, out=np.ones(3), where=other > 0)

    with one_thread(), ThreadPoolExecutor(processors()) as threads:
        ratios = np.array(list(threads.map(ratio, product(*axes)))).T.reshape(3, len(axes[0]), len(axes[1]))
    down, across = (_interpolation(size, axis) for size, axis in zip(shape, axes, strict=True))
    whole = [down @ each @ across.T for each in ratios]
    return VarianceMap(variances.posterior * whole[0], variances.missing * whole[1], variances.noisy * whole[2])


def _interpolation(size: int, axis: list[Stretch]) -> FloatArray:
    """Return the matrix from values of cores along an axis to its pixels, linear, constant beyond: (size, cores)."""
    middles = [each.first + (each.core.start + each.core.stop) / 2 for each in axis]
    return np.stack([np.interp(np.arange(size) + 0.5, middles, unit) for unit in np.eye(len(middles))], axis=1)
