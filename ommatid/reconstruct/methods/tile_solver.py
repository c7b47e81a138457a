"""A frame in overlapping tiles, each estimated from the measurements that depend on no pixel outside it.

Only the core of each tile is kept. Its border, which lacks the measurements that extend beyond it, belongs to the cores
of the neighbours. Tiles with the same H and noise share one factorisation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.machine import one_thread
from ommatid.scenes.tables.estimation import EstimatorTable

from ..estimator.estimate import estimate
from ..expected_error import ExpectedError, expected_error, squared_error
from ..forms.form import Form
from ..output.run_json import SolverReport
from ..prior import Prior
from ..problem import Problem

NEIGHBOURS = 9  # tiles with correlated errors: the variance of a sum is at most so many times the sum of theirs


@dataclass(frozen=True)
class Tile:
    """A window of the frame and its core, each as slices of rows and columns."""

    window: tuple[slice, slice]
    core: tuple[slice, slice]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        rows, columns = self.window
        return rows.stop - rows.start, columns.stop - columns.start

    @property
    def kept(self) -> NDArray[np.intp]:
        """Indices of the core's pixels in the window, row by row."""
        inside: BoolArray = np.zeros(self.shape, dtype=np.bool_)
        top, left = (window.start for window in self.window)
        rows, columns = self.core
        inside[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = True
        return np.flatnonzero(inside)


def overlapping_tiles(shape: tuple[int, int], size: int, overlap: int) -> list[Tile]:
    """Return tiles of at most `size` x `size` pixels whose cores, `overlap` less on each side, partition the frame."""
    rows, columns = (list(_intervals(length, size, overlap)) for length in shape)
    return [Tile((row[0], column[0]), (row[1], column[1])) for row, column in product(rows, columns)]


def _intervals(length: int, size: int, overlap: int) -> Iterator[tuple[slice, slice]]:
    """Windows and cores along one axis."""
    first = 0
    while first < length:
        start = max(first - overlap, 0)
        stop = min(start + size, length)
        last = length if stop == length else stop - overlap
        if stop == length:  # the last window gets full size, too: more measurements lie inside it
            start = max(length - size, 0)
        yield slice(start, stop), slice(first, last)
        first = last


@dataclass(frozen=True)
class TileTask:
    """Tiles that differ only in their measurements, so that one factorisation serves all.

    recorded : (m, tiles) g;  noise : (m,) actual noise variances by cause, empty to estimate images only
    kept : indices of the core's pixels;  truth : (n, tiles) true images, if known
    deviations : (m, tiles, columns) deviations of g from H f0 that are to pass through the estimator, too
    """

    matrix: sparse.csr_array
    recorded: FloatArray
    expected_noise: FloatArray
    noise: dict[str, FloatArray]
    prior: Prior
    kept: NDArray[np.intp]
    settings: EstimatorTable
    truth: FloatArray | None = None
    deviations: FloatArray | None = None

    @property
    def problem(self) -> Problem:
        """The inverse problem of one tile."""
        return Problem(self.matrix, self.prior, self.expected_noise)


@dataclass(frozen=True)
class SolvedTiles:
    """Images of the kept pixels, (kept, tiles), and their error.

    expected : Eq. 5 of the kept pixels, the same for all tiles of a task; None where images alone were asked for
    given : (2, tiles) sums over the pixels of the expected error for the true image, and their variances
    responses : (kept, tiles, columns) A applied to the deviations of the task
    """

    image: FloatArray
    solver: SolverReport
    expected: ExpectedError | None = None
    given: FloatArray | None = None
    responses: FloatArray | None = None


def solve_tiles(task: TileTask) -> SolvedTiles:
    """Factorise once and estimate every tile of a task. Raises InputError if no form reaches the tolerance."""
    problem = task.problem
    first = estimate(problem, task.recorded[:, 0], task.settings.tolerance)
    image = first.image[task.kept, None]
    if task.recorded.shape[1] > 1:
        residual = task.recorded - (problem.matrix @ problem.prior.mean)[:, None]
        image = (problem.prior.mean[:, None] + first.form.gain(residual))[task.kept]
    if not task.noise:
        return SolvedTiles(image, first.solver)
    expected = expected_error(first.form, task.noise, pixels=task.kept)
    given = None if task.truth is None else _error_given(task, first.form, task.truth)
    responses = None if task.deviations is None else _responses(first.form, task.deviations, task.kept)
    return SolvedTiles(image, first.solver, expected, given, responses)


def _responses(form: Form, deviations: FloatArray, kept: NDArray[np.intp]) -> FloatArray:
    _, tiles, columns = deviations.shape
    return form.gain(deviations.reshape(-1, tiles * columns))[kept].reshape(-1, tiles, columns)


def solve_tiles_single_threaded(task: TileTask) -> SolvedTiles:
    """Solve a task in a worker process with one thread, because the number of threads changes the last digits."""
    with one_thread():
        return solve_tiles(task)


def _error_given(task: TileTask, form: Form, truth: FloatArray) -> FloatArray:
    """(2, tiles): |(I - A H)(f - f0)|^2 + trace(A Rvm A^T) over the kept pixels, and an upper bound on its variance."""
    deviation = truth - form.problem.prior.mean[:, None]
    bias = (deviation - form.gain(form.problem.matrix @ deviation))[task.kept]
    actual = np.sum(list(task.noise.values()), axis=0)
    mean, variance = squared_error(form, bias, actual, task.kept)
    return np.stack([mean, NEIGHBOURS * variance])


def transposed_gain(task: TileTask, weights: FloatArray) -> FloatArray:
    """Return A^T w of a tile: (n,) weights of its pixels to (m,)."""
    problem = task.problem
    form = estimate(problem, task.recorded[:, 0], task.settings.tolerance).form
    shift = problem.prior.apply_root_transposed(weights[:, None])
    _, negative = form.solve(shift, np.zeros((problem.measurements, 1)))
    return -negative[:, 0]
