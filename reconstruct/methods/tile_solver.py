"""A frame in overlapping tiles, each reconstructed on its own from the measurements that see nothing else.

Of every tile the core is kept; the border, where measurements are missing that reach beyond it, is dropped: neighbours
have it. Tiles in which H and the noise are the same share one factorisation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.processors import one_thread
from ommatid.scenes.tables.estimation import EstimatorTable

from ..estimator.estimate import FORMS, Solver, estimate
from ..expected_error import expected_error
from ..forms.form import Form
from ..prior import Prior
from ..problem import Problem

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

NEIGHBOURS = 9  # tiles whose errors go with a tile's: the variance of a sum is at most so many times the sum of theirs


@dataclass(frozen=True)
class Tile:
    """A window of the frame, and its core, both as slices of rows and of columns."""

    window: tuple[slice, slice]
    core: tuple[slice, slice]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        rows, columns = self.window
        return rows.stop - rows.start, columns.stop - columns.start

    @property
    def kept(self) -> NDArray[np.intp]:
        """Which pixels of the window, row by row, are the core's."""
        inside = np.zeros(self.shape, dtype=np.bool_)
        starts = [window.start for window in self.window]
        rows, columns = (slice(core.start - at, core.stop - at) for core, at in zip(self.core, starts, strict=True))
        inside[rows, columns] = True
        return np.flatnonzero(inside)


def cut(shape: tuple[int, int], size: int, overlap: int) -> list[Tile]:
    """Tiles of at most `size` x `size` pixels whose cores, `overlap` less on each side, share out the frame."""
    axes = [list(_cut(length, size, overlap)) for length in shape]
    return [
        Tile((rows, columns), (core_rows, core_columns))
        for rows, core_rows in axes[0]
        for columns, core_columns in axes[1]
    ]


def _cut(length: int, size: int, overlap: int) -> Iterator[tuple[slice, slice]]:
    first = 0
    while first < length:
        start = max(first - overlap, 0)
        stop = min(start + size, length)
        last = length if stop == length else stop - overlap
        if stop == length:  # the last tile is as large as the others, the more it sees
            start = max(length - size, 0)
        yield slice(start, stop), slice(first, last)
        first = last


@dataclass(frozen=True)
class TileTask:
    """Tiles that differ in what was recorded alone: the work of one factorisation.

    recorded : (m, tiles) g;  noise : (m,) variances by name, of the noise as it is
    kept : which pixels of a window count;  truth : (n, tiles) where the image is known
    """

    matrix: sparse.csr_array
    recorded: Matrix
    believed: Vector
    noise: dict[str, Vector]
    prior: Prior
    kept: NDArray[np.intp]
    told: EstimatorTable
    truth: Matrix | None = None
    image_only: bool = False


@dataclass(frozen=True)
class SolvedTile:
    """What becomes of a piece, for the pixels kept: images (kept, tiles); the rest is the same for all its tiles.

    variance, resolved : (kept,), of Eq. 5 and of A H;  missing, parts : means over them of what Eq. 5 consists of
    given : for each tile, sums over them of the error to be expected where the truth is known, and its variance
    """

    image: Matrix
    solver: Solver
    variance: Vector
    resolved: Vector
    missing: float
    parts: dict[str, float]
    given: Matrix | None


def work(piece: TileTask) -> SolvedTile:
    """Factorise once, then estimate every tile of a piece. Raises InputError where no form is right."""
    problem = Problem(piece.matrix, piece.prior, piece.believed)
    method = piece.told.method if piece.told.method in FORMS else "auto"
    first = estimate(problem, piece.recorded[:, 0], method, piece.told.tolerance)
    image = first.image[piece.kept, None]
    if piece.recorded.shape[1] > 1:
        away = piece.recorded - (problem.matrix @ problem.prior.mean)[:, None]
        image = (problem.prior.mean[:, None] + first.form.gain(away))[piece.kept]
    if piece.image_only:
        nothing = np.zeros(0)
        return SolvedTile(image, first.solver, nothing, nothing, 0.0, {}, None)
    expected = expected_error(first.form, piece.noise, pixels=piece.kept)
    given = None if piece.truth is None else _given(piece, first.form, piece.truth)
    return SolvedTile(
        image, first.solver, expected.variance, expected.resolved, expected.missing, expected.parts, given
    )


def work_alone(piece: TileTask) -> SolvedTile:
    """The same in a process of its own: by one thread, for more of them change the last digits."""
    with one_thread():
        return work(piece)


def _given(piece: TileTask, form: Form, truth: Matrix) -> Matrix:
    """(2, tiles): |(I - A H)(f - f0)|^2 + trace(A Rvm A^T) over the pixels kept, and at most so much variance of it."""
    away = truth - form.problem.prior.mean[:, None]
    bias = (away - form.gain(form.problem.matrix @ away))[piece.kept]
    actual = np.sum(list(piece.noise.values()), axis=0)
    _, negative = form.columns(piece.kept)
    together = negative.T @ (actual[:, None] * negative)
    own = 4 * np.einsum("it,it->t", bias, together @ bias) + 2 * float(np.square(together).sum())
    return np.stack([np.square(bias).sum(axis=0) + float(np.trace(together)), NEIGHBOURS * own])


def pulled(piece: TileTask, weights: Vector) -> Vector:
    """A^T w of a tile: (n,) weights of its pixels to (m,)."""
    problem = Problem(piece.matrix, piece.prior, piece.believed)
    form = estimate(problem, piece.recorded[:, 0], tolerance=piece.told.tolerance).form
    _, negative = form.solve(problem.prior.gather(weights[:, None]), np.zeros((problem.measurements, 1)))
    return -negative[:, 0]
