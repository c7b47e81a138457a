"""Exact merging of separately estimated tiles by the measurements that couple them (Wood et al. 2005, Eq. 7).

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

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product

import numpy as np
from scipy import linalg, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError

from ..forms.form import NotSolvableError
from ..forms.square_root import Indices, square_root
from ..prior import Prior
from ..problem import Problem


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
    _check_measurements(problem, recorded, numbers)
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


def _check_measurements(problem: Problem, recorded: FloatArray, numbers: Indices) -> None:
    if recorded.shape != (problem.measurements,) or not np.isfinite(recorded[numbers]).all():
        raise InputError(
            f"expected {problem.measurements} finite measurements, got others; leave dead pixels out first"
        )
    if not (problem.noise_variance[numbers] > 0).all():
        raise InputError("merging tiles needs measurements with noise only; set estimator.noise_variance above 0")
