"""A frame in overlapping tiles, each estimated from the measurements that depend on no pixel outside it.

Only the core of each tile is kept. Its border, which lacks the measurements that extend beyond it, belongs to the cores
of the neighbours. Tiles with the same H and noise share one factorisation.

Disjoint tiles are merged exactly by the measurements that couple them (Wood et al. 2005, Eq. 7).

A frame is cut into disjoint tiles of pixels that are independent in the prior. A measurement belongs to a tile if all
pixels it depends on lie in the tile; the others couple tiles. Eq. 7 merges tiles by the matrix inversion lemma, whose
differences lose half the digits or more if the noise is far below the prior. Here a posterior is stored as a square
root T of its covariance, T T^T, and updated by orthogonal transformations. With H, g and Rv = S^2 of the new
measurements and the previous mean m,

    B = S^-1 H T,    T (I + B^T B)^-1 T^T,    m + T (I + B^T B)^-1 B^T S^-1 (g - H m)

are the updated covariance and mean: those of a problem whose prior has the root T, in the square-root form.

Where single tiles leave a direction undetermined, rounding errors of T, 1e-16 of the prior's standard deviation, exceed
a small noise: means were accurate to 1e-13 of that standard deviation at a noise variance of 1e-2, to 2e-12 at 1e-6 and
to 3e-9 at 1e-10 (the paper's lenses).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread
from ommatid.scenes.tables.estimation import EstimatorTable

from ..estimator.estimate import estimate
from ..expected_error import ExpectedError, expected_error, squared_error
from ..forms.square_root import Indices, square_root
from ..output.run_json import SolverReport
from ..prior import Prior
from ..problem import Form, NotSolvableError, Problem

NEIGHBOURS = 9  # tiles with correlated errors: the variance of a sum is at most so many times the sum of theirs


@dataclass(frozen=True)
class Posterior:
    """Mean and covariance of some pixels of a frame.

    pixels : (n,) indices of the pixels, in ascending order
    mean : (n,) their estimate f^
    root : (n, K) T, where T T^T is their covariance
    """

    pixels: Indices
    mean: FloatArray
    root: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """T T^T: (n, n)."""
        return self.root @ self.root.T

    @property
    def variance(self) -> FloatArray:
        """The diagonal of T T^T: (n,), as sums of squares."""
        return np.square(self.root).sum(axis=1)


def disjoint_tiles(shape: tuple[int, int], tile: tuple[int, int]) -> list[Indices]:
    """Return the pixels of tiles of (rows, columns) `tile`, row by row; those at the far ends may be smaller."""
    grid = np.arange(shape[0] * shape[1], dtype=np.intp).reshape(shape)
    starts = product(*(range(0, size, step) for size, step in zip(shape, tile, strict=True)))
    return [grid[row : row + tile[0], column : column + tile[1]].ravel() for row, column in starts]


def tile_posterior(problem: Problem, recorded: FloatArray, pixels: Indices) -> Posterior:
    """Return the posterior of a tile from its own measurements, of a frame's `problem` and (M,) `recorded`.

    Raises InputError for correlated pixels, for pixels outside the frame or given twice, and if one of the tile's
    measurements is not finite or has no noise.
    """
    if not problem.prior.independent:
        raise InputError("merging tiles needs a prior of independent pixels; solve the frame as a whole")
    tile = np.unique(pixels)
    if tile.size != pixels.size or tile.size == 0 or tile[0] < 0 or tile[-1] >= problem.unknowns:
        raise InputError(f"expected pixels from 0 to {problem.unknowns - 1} in a tile, each once and at least one")
    prior = Posterior(tile, problem.prior.mean[tile], np.diag(problem.prior.root[tile]))
    return _updated(prior, problem, recorded, np.flatnonzero(_inside(problem, tile)))


def merge_posteriors(first: Posterior, second: Posterior, problem: Problem, recorded: FloatArray) -> Posterior:
    """Return the joint posterior of two tiles, updated by the measurements that depend on pixels of both only.

    Raises InputError if they share pixels, and if such a measurement is not finite or has no noise.
    """
    pixels = np.concatenate([first.pixels, second.pixels])
    order = np.argsort(pixels, kind="stable")
    if np.unique(pixels).size != pixels.size:
        raise InputError("tiles to be merged share pixels; cut the frame into tiles that do not overlap")
    mean = np.concatenate([first.mean, second.mean])
    root: FloatArray = linalg.block_diag(first.root, second.root)
    coupling = _inside(problem, pixels) & ~_inside(problem, first.pixels) & ~_inside(problem, second.pixels)
    return _updated(Posterior(pixels[order], mean[order], root[order]), problem, recorded, np.flatnonzero(coupling))


def merge_tiles(problem: Problem, recorded: FloatArray, tiles: Sequence[Indices]) -> Posterior:
    """Return the posterior of all `tiles` together: each is estimated alone and merged with those before it.

    If the tiles partition the frame, all measurements are used. Raises InputError as `tile_posterior` and
    `merge_posteriors` do.
    """
    if not tiles:
        raise InputError("expected one tile or more to merge, got none")
    posteriors = (tile_posterior(problem, recorded, tile) for tile in tiles)
    return reduce(lambda merged, tile: merge_posteriors(merged, tile, problem, recorded), posteriors)


def _inside(problem: Problem, pixels: Indices) -> BoolArray:
    """True for measurements that depend on some of these pixels and on no others: (M,)."""
    inside = np.zeros(problem.unknowns)
    inside[pixels] = 1.0
    matrix = problem.matrix
    pattern = sparse.csr_array(
        ((matrix.data != 0).astype(np.float64), matrix.indices, matrix.indptr), shape=matrix.shape
    )
    return (np.asarray(pattern @ inside) > 0) & (np.asarray(pattern @ (1.0 - inside)) == 0)


def _updated(before: Posterior, problem: Problem, recorded: FloatArray, numbers: Indices) -> Posterior:
    """Return the posterior after the measurements `numbers`, by the equations of the module docstring."""
    problem.check(recorded, numbers)
    if not (problem.noise_variance[numbers] > 0).all():
        raise InputError("merging tiles needs measurements with noise only; set estimator.noise_variance above 0")
    if not numbers.size:
        return before
    rows = sparse.csr_array(problem.matrix[numbers][:, before.pixels])
    part = Problem(rows, Prior(before.mean, before.root), problem.noise_variance[numbers])
    residual = recorded[numbers] - rows @ before.mean
    try:
        with np.errstate(all="ignore"):  # overflow is refused below
            form = square_root(part)
            step, _ = form.solve(np.zeros((part.prior.dimension, 1)), residual[:, None])
            after = Posterior(
                before.pixels, before.mean + before.root @ step[:, 0], before.root @ form.normal.inverse()
            )
    except NotSolvableError:
        after = None
    if after is None or not (np.isfinite(after.mean).all() and np.isfinite(after.variance).all()):
        raise InputError(
            "the noise is too small relative to the prior or the measurements for double precision; raise it"
        )
    return after


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
