"""Join tiles, reconstructed each on its own, exactly, by the measurements that couple them (Wood et al., Eq. 7).

A frame is cut into disjoint tiles of pixels, independent of one another beforehand. A measurement belongs to a tile if
all the pixels that it sees lie in it; the others couple tiles. Eq. 7 joins tiles by the lemma for (A + B C D)^-1,
whose differences lose half the digits and more where the noise is far below the prior. Here a posterior is kept as a
square root T of its covariance, T T^T, and the same update is made of orthogonal transformations. With H, g and
Rv = S^2 of the measurements that are new, and m the mean before,

    B = S^-1 H T,    T (I + B^T B)^-1 T^T,    m + T (I + B^T B)^-1 B^T S^-1 (g - H m)

are the covariance and the mean after. Of I + B^T B only as many directions differ from I as B has rows that tell
something new, a small part of a tile's pixels, and only in these is it factorised.

Variances are right to 1e-14 of each at any noise. What rounding leaves of T where tiles alone leave a direction open,
1e-16 of the prior's deviation, is more beside a small noise: means were found right to 1e-13 of that deviation at a
noise variance of 1e-2, to 2e-12 at 1e-6 and to 3e-9 at 1e-10 (the paper's lenses, five tiles of 19 x 19 at most).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.errors import InputError

from ..forms.sorted_qr import sorted_qr
from ..problem import Problem

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.intp]

ROUNDING = 64 * float(np.finfo(np.float64).eps)  # of sums of products, for all that is lost before in T
LARGEST = 1e150  # whose square is a number
BLOCK = 64  # columns that LAPACK applies together


@dataclass(frozen=True)
class Posterior:
    """What is known of some pixels of a frame.

    pixels : (n,) which of the frame's pixels, in ascending order
    mean : (n,) the estimate f^ of them
    root : (n, K) T, with T T^T their covariance; its columns have no meaning of their own
    """

    pixels: Indices
    mean: Vector
    root: Matrix

    @property
    def covariance(self) -> Matrix:
        """T T^T: (n, n)."""
        return self.root @ self.root.T

    @property
    def variance(self) -> Vector:
        """The diagonal of T T^T: (n,), sums of squares and so never below 0."""
        return np.square(self.root).sum(axis=1)


def cut(shape: tuple[int, int], tile: tuple[int, int]) -> list[Indices]:
    """The pixels of tiles of (rows, columns) `tile`, row by row; those at the far ends may be smaller."""
    grid = np.arange(shape[0] * shape[1], dtype=np.intp).reshape(shape)
    starts = [range(0, size, step) for size, step in zip(shape, tile, strict=True)]
    return [grid[row : row + tile[0], column : column + tile[1]].ravel() for row in starts[0] for column in starts[1]]


def alone(problem: Problem, recorded: Vector, pixels: Indices) -> Posterior:
    """A tile's posterior from the measurements that it has to itself, of a frame's `problem` and (M,) `recorded`.

    Raises InputError for a prior under which tiles are not independent, for pixels that are not the frame's or come
    twice, and where one of its measurements is no number or is said to have no noise.
    """
    if not problem.prior.independent:
        raise InputError("tiles are joined under a prior of independent pixels only; solve the frame as a whole")
    tile = np.unique(pixels)
    if tile.size != pixels.size or tile.size == 0 or tile[0] < 0 or tile[-1] >= problem.unknowns:
        raise InputError(f"a tile takes pixels from 0 to {problem.unknowns - 1}, each once and at least one")
    prior = Posterior(tile, problem.prior.mean[tile], np.diag(problem.prior.root[tile]))
    return _updated(prior, problem, recorded, np.flatnonzero(_sees_only(problem, tile)))


def merge(first: Posterior, second: Posterior, problem: Problem, recorded: Vector) -> Posterior:
    """Both tiles' posterior together: theirs side by side, and the measurements that see pixels of both and no others.

    Raises InputError if they share pixels, and where such a measurement is no number or is said to have no noise.
    """
    pixels = np.concatenate([first.pixels, second.pixels])
    order = np.argsort(pixels, kind="stable")
    if np.unique(pixels).size != pixels.size:
        raise InputError("tiles that are to be joined share pixels; cut the frame into tiles that do not overlap")
    mean = np.concatenate([first.mean, second.mean])
    beside: Matrix = linalg.block_diag(first.root, second.root)
    coupling = _sees_only(problem, pixels)
    for one in (first, second):
        coupling &= ~_sees_only(problem, one.pixels)
    return _updated(Posterior(pixels[order], mean[order], beside[order]), problem, recorded, np.flatnonzero(coupling))


def sweep(problem: Problem, recorded: Vector, tiles: Sequence[Indices]) -> Posterior:
    """The posterior of all `tiles` together, each solved alone and joined to those before it.

    If they are the whole frame, so are the measurements that are used. Raises InputError as `alone` and `merge` do.
    """
    if not tiles:
        raise InputError("expected one tile or more to sweep over, got none")
    found = (alone(problem, recorded, tile) for tile in tiles)
    return reduce(lambda done, tile: merge(done, tile, problem, recorded), found)


def _sees_only(problem: Problem, pixels: Indices) -> NDArray[np.bool_]:
    """Which measurements see some of these pixels and no others: (M,)."""
    inside = np.zeros(problem.unknowns)
    inside[pixels] = 1.0
    matrix = problem.matrix
    seen = sparse.csr_array(((matrix.data != 0).astype(np.float64), matrix.indices, matrix.indptr), shape=matrix.shape)
    within, beyond = np.asarray(seen @ inside), np.asarray(seen @ (1.0 - inside))
    return (within > 0) & (beyond == 0)


def _updated(before: Posterior, problem: Problem, recorded: Vector, some: Indices) -> Posterior:
    """The posterior after some measurements more, as the module's text has it."""
    _refuse(problem, recorded, some)
    rows = sparse.csr_array(problem.matrix[some][:, before.pixels])
    with np.errstate(all="ignore"):  # what overflows is refused
        away = (recorded[some] - rows @ before.mean) / problem.deviation[some]
        observed, doubt = _observed(rows, before.root, problem.deviation[some])
    for values in (away, observed, doubt):
        if not np.abs(values).max(initial=0.0) < LARGEST:
            raise InputError("so little noise beside the prior or the measurements leaves double precision; raise it")
    triangle, told, order = _told(observed, np.linalg.norm(doubt, axis=0), away)
    rank = told.size
    if rank == 0:
        return before
    turned, narrow = _turned(before.root[:, order], triangle)
    normal = sorted_qr(np.vstack([narrow.T, np.eye(rank)]))
    step = normal.solve(np.concatenate([told, np.zeros(rank)])[:, None])[:, 0]
    root = np.hstack([turned[:, :rank] @ normal.inverse(), turned[:, rank:]])
    return Posterior(before.pixels, before.mean + turned[:, :rank] @ step, root)


def _refuse(problem: Problem, recorded: Vector, some: Indices) -> None:
    if recorded.shape != (problem.measurements,) or not np.isfinite(recorded[some]).all():
        raise InputError(
            f"expected {problem.measurements} finite measurements, got others; leave dead pixels out first"
        )
    if not (problem.noise_variance[some] > 0).all():
        raise InputError("tiles are joined by measurements with noise only; set estimator.noise_variance above 0")


def _observed(rows: sparse.csr_array, root: Matrix, deviation: Vector) -> tuple[Matrix, Matrix]:
    """B, (q, K), and how much of its entries may be rounding, (q, K); what may be nothing else is 0 in both.

    A tile alone leaves directions open that H sees nothing of. What rounding makes of their zeros is nothing beside
    the prior but much beside a small noise, and would be taken for news of them.
    """
    observed = np.asarray(rows @ root) / deviation[:, None]
    doubt = ROUNDING * np.asarray(abs(rows) @ np.abs(root)) / deviation[:, None]
    nothing = np.abs(observed) <= doubt
    observed[nothing] = 0.0
    doubt[nothing] = 0.0
    return observed, doubt


def _told(observed: Matrix, doubt: Vector, away: Vector) -> tuple[Matrix, Vector, Indices]:
    """What measurements say without repeating one another: R, (r, K), Q^T S^-1 (g - H m), (r,), and an order.

    B = Q R with its columns in that order, by pivoting, so that directions of large variance come first. Where nothing
    but rounding is left of a column, (K,) `doubt` of its norm, it becomes 0: then open directions stay apart from well
    known ones, which are far smaller.
    """
    found = sorted_qr(observed)
    last = min(observed.shape)
    left = np.sqrt(np.cumsum(np.square(found.triangle)[::-1], axis=0)[::-1])
    triangle = np.where(left > doubt[found.pivots], found.triangle, 0.0)
    sound = np.diagonal(triangle) != 0
    rank = last if sound.all() else int(np.argmin(sound))
    return triangle[:rank], found.orthogonal[:, :rank].T @ away[found.rows], found.pivots


def _turned(root: Matrix, triangle: Matrix) -> tuple[Matrix, Matrix]:
    """T Q, (n, K), and W, (r, r), of R^T = Q [W; 0]; Q is never formed, so this costs 4 n K r operations."""
    decompose: Any = linalg.qr
    lapack: Any = linalg.lapack
    (reflectors, factors), narrow = decompose(triangle.T, mode="raw", check_finite=False)
    turned, _, _ = lapack.dormqr("R", "N", reflectors, factors, root, BLOCK * root.shape[0])
    return turned, narrow[: triangle.shape[0]]
