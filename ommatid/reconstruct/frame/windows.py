"""The expected error (Eq. 5) of f's pixels from windows of a frame side by side, for any camera and any noise.

Each window has a halo, and its own readings: what these see beside it counts as noise. Variances are too large by what
a longer halo would show. That depends on a pixel's place in its core, and hardly on the window: some windows with a
long halo correct all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Entries, Observation, ObservationPart

from ..methods.method import EstimationTask
from ..problem import dense_or_sparse, gram
from .bands import Bands
from .swept import swept_maps
from .variance_map import (
    Interior,
    VarianceMap,
    columns_of_covariance,
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
REPEATS = 5  # windows with the same footprints, from which one and how the others differ are faster than all
PLACES = 6  # digits of places of readings, in pixels of f, beyond which they are rounded otherwise everywhere
MOVED = 0.1  # change of a variance by other noise up to which it is known to a hundredth
VARYING = 0.05  # variation of kernels from which windows count it; one of 0.09 makes a map 11 % wrong


class Stretch(NamedTuple):
    """Rows or columns of a window: the first of them in the frame, and its core among them."""

    first: int
    core: slice


@dataclass(frozen=True)
class Response:
    """The maps of the core of a window, and what they are for noise of its readings that is not far from that at hand.

    The noise of a reading changes C by a matrix of rank one. The maps are those of the sum of these matrices, in which
    products of two of them are left out. With D = C P0^-1 C:

    posterior, missing : (rows, columns) diagonals of C and D;  noise : (readings,) Rv
    beside : (readings,) its part by what they see beside the window
    squares, products : (readings, pixels) of (H C)^2 and of H C times H D
    leverage, prior_leverage : (readings,) diagonals of H C H^T and H D H^T
    """

    posterior: FloatArray
    missing: FloatArray
    noise: FloatArray
    beside: FloatArray
    squares: NDArray[np.float32]
    products: NDArray[np.float32]
    leverage: FloatArray
    prior_leverage: FloatArray

    def maps(self, expected: FloatArray, actual: FloatArray) -> FloatArray | None:
        """Return the three maps, (3, rows, columns), or None if the noise is too far from that at hand.

        expected, actual : (readings,) noise without the part from beside the window, infinite and 0 where unused
        """
        weights = 1 / (expected + self.beside)
        change = weights - 1 / self.noise
        shrunk = 1 / (1 + change * self.leverage)
        change *= shrunk
        excess = np.zeros_like(weights)
        np.multiply(actual - expected, np.square(weights * shrunk), out=excess, where=weights > 0)
        by_squares = np.array([-change, np.square(change) * self.prior_leverage, excess], dtype=np.float32)
        more, own, noisier = (by_squares @ self.squares).reshape(3, *self.posterior.shape)
        if (np.abs(more) > MOVED * self.posterior).any():
            return None
        posterior = self.posterior + more
        less = 2 * (change.astype(np.float32) @ self.products).reshape(self.posterior.shape)
        missing = self.missing + own - less
        return np.array([posterior, missing, posterior - missing + noisier])


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
        """Return the maps of a whole frame from the cores of windows side by side.

        Of windows with the same footprints one is solved, from which the others follow where their noise is similar.
        """
        applied, (rows, columns) = self._as_matrices(observation), self._stretches
        places, alike = list(product(rows, columns)), list(np.ndindex(len(rows), len(columns)))
        if self.task.finer == 1 and not is_narrow(self.task):
            alike = list(product(self._first_alike(observation, 0), self._first_alike(observation, 1)))
        shared = [first for first, count in Counter(alike).items() if count >= REPEATS]

        def response(first: tuple[int, int]) -> Response:
            row, column = rows[first[0]], columns[first[1]]
            return self._response(applied, (row.first, column.first), (row.core, column.core))

        def at(place: tuple[Stretch, Stretch], first: tuple[int, int]) -> FloatArray:
            corner, core = (place[0].first, place[1].first), (place[0].core, place[1].core)
            maps = None
            if first in responses:
                numbers = self._near(corner)
                numbers = numbers[self._order(numbers, corner)]
                if responses[first].noise.size == numbers.size:  # unless one lies at an edge of the window, by rounding
                    maps = responses[first].maps(*(noise[numbers] for noise in self._noise))
            return self.map(applied, corner, core) if maps is None else maps

        with one_thread(), ThreadPoolExecutor(processors()) as threads:
            responses = dict(zip(shared, threads.map(response, shared), strict=True))
            found = list(threads.map(at, places, alike))
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

    @cached_property
    def _noise(self) -> tuple[FloatArray, FloatArray]:
        """Expected and actual noise, infinite and 0 where readings are not used: (M,) each."""
        task = self.task
        return task.on_all_measurements(task.expected_noise, np.inf), task.on_all_measurements(self.actual, 0.0)

    @cached_property
    def _even_noise(self) -> FloatArray:
        """Expected noise that is even over each lens type, as of most readings: (M,)."""
        parts = [self._noise[0][part] for part in self.task.model.camera.type_slices()]
        medians = np.array([np.median(part) for part in parts])
        return np.repeat(np.where(np.isfinite(medians), medians, 1.0), [part.size for part in parts])

    def _response(self, observation: Observation, corner: tuple[int, int], core: Core) -> Response:
        """Return the maps of the core of a window with even noise, and what they are for other noise."""
        shape, numbers = self.shape, self._near(corner)
        order, (matrix, beside) = self._order(numbers, corner), self._cut(observation, corner, numbers)
        matrix, beside, numbers = matrix[order], beside[order], numbers[order]
        noise, applied = self._even_noise[numbers] + beside, dense_or_sparse(matrix)
        precision = gram(applied, 1 / noise) + self._precision
        covariance, missing = columns_of_covariance(precision, 1 / self._spectrum, np.arange(shape[0] * shape[1]))
        kept = np.arange(shape[0] * shape[1]).reshape(shape)[core]
        pixels, of_c = kept.ravel(), applied @ covariance
        of_d = applied @ (covariance @ (self._precision @ covariance[:, pixels]))
        squares, products = (np.asarray(of_c[:, pixels] * each, np.float32) for each in (of_c[:, pixels], of_d))
        leverage = np.asarray(matrix.multiply(of_c).sum(axis=1), np.float64).ravel()
        waves = np.asarray(fft.dctn(of_c.reshape(-1, *shape), 2, axes=(1, 2), norm="ortho"))
        prior_leverage = np.einsum("rc,irc->i", 1 / self._spectrum, np.square(waves))
        posterior, missing = (each[kept] for each in (np.diagonal(covariance), missing))
        return Response(posterior, missing, noise, beside, squares, products, leverage, prior_leverage)

    def _order(self, numbers: IntArray, corner: tuple[int, int]) -> IntArray:
        """Return the order of readings by lens type and place in a window, that of all windows with its footprints."""
        camera = self.task.model.camera
        ends = [part.stop for part in camera.type_slices()]
        down, across = (
            (middles[numbers] - first).round(PLACES) for middles, first in zip(camera.middles, corner, strict=True)
        )
        return np.lexsort((across, down, np.searchsorted(ends, numbers, "right")))

    def _first_alike(self, observation: Observation, axis: int) -> list[int]:
        """Return, for every window along an axis, the number of the first one with the same footprints.

        Behind pinholes, displaced or not, they repeat with the period of all lens types together.
        """
        side, size, reach = self.shape[axis], self.task.shape_of_f[axis], observation.reach
        patterns: list[Hashable] = []
        for first, core in self._stretches[axis]:
            before, after = min(first, reach), min(size - first - side, reach)  # where footprints lie in part beside it
            wide, other = slice(first - before, first + side + after), slice(0, self.shape[1 - axis])
            footprints = observation.signature(*((other, wide) if axis else (wide, other)))
            patterns.append((before, after, core.start, core.stop, footprints))
        return [patterns.index(each) for each in patterns]

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
