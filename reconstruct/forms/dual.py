"""Dual form: of all (u, w) with H L u + S w = r the one of least norm, by pivoted QR of [H L, S].

It divides by neither S nor L and so serves measurements without noise, pixels that are known, and noise of very
different size side by side. Pivoting splits (u, w) into basic variables, which the measurements determine, and free
ones t, for which the prior speaks: basic = y - W t with W = R1^-1 R2. Small variances then come from small numbers,
not from differences of large ones. The dearest form: cubic in measurements and unknowns together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from ..problem import Problem
from .form import Form, Matrix, Vector, root_variance
from .sorted_qr import Indices, SortedQr, sorted_qr

EPS = float(np.finfo(np.float64).eps)
SWEEPS = 30


@dataclass(frozen=True)
class Dual(Form):
    """Rows with signal `active`, divided by `scale`; [H L, S] of them is Q [R1 R2] in the order `basic`, `free`.

    orthogonal : (m, rank) Q
    triangle : (rank, rank) R1;  weights : (rank, K + m - rank) W
    normal : the QR of [W; I]
    """

    active: Indices
    scale: Vector
    basic: Indices
    free: Indices
    orthogonal: Matrix
    triangle: Matrix
    weights: Matrix
    normal: SortedQr

    name: ClassVar[str] = "dual"

    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """The (u, w) nearest to (c, 0) that meets r; l from the basic columns of (H L, S)^T l = (u - c, w)."""
        freedoms, rank = self.problem.prior.freedoms, self.basic.size
        scaled = residual[self.active] / self.scale[:, None]
        target = np.zeros((freedoms + self.active.size, shift.shape[1]))
        target[:freedoms] = shift
        particular = linalg.solve_triangular(self.triangle, self.orthogonal.T @ scaled, check_finite=False)
        right = np.vstack([particular - target[self.basic], target[self.free]])
        chosen = self.normal.solve(right)
        found = np.empty_like(target)
        found[self.free] = chosen
        found[self.basic] = particular - self.weights @ chosen
        moved = (found - target)[self.basic]
        multiplier = np.zeros_like(residual)
        if rank:
            some = self.orthogonal @ linalg.solve_triangular(self.triangle, moved, trans="T", check_finite=False)
            multiplier[self.active] = some / self.scale[:, None]
        noise = self.problem.noise_variance
        silent = np.setdiff1d(np.flatnonzero(noise > 0), self.active)
        multiplier[silent] = residual[silent] / noise[silent, None]
        return found[:freedoms], multiplier

    def variance(self) -> Vector:
        """The diagonal of L T T^T L^T, T = [I; -W] R^-1 in the rows of u."""
        inverse = self.normal.inverse()
        root = np.zeros((self.problem.prior.freedoms + self.active.size, self.free.size))
        root[self.free] = inverse
        root[self.basic] = -self.weights @ inverse
        return root_variance(self.problem, root[: self.problem.prior.freedoms])


def dual(problem: Problem) -> Dual:
    """Factorise in dual form."""
    observed = problem.observed()
    active = np.flatnonzero(observed.any(axis=1))
    scale = _row_scale(observed[active])
    signal, noise = observed[active] / scale[:, None], problem.deviation[active] / scale
    rows = np.argsort(-np.maximum(np.abs(signal).max(axis=1, initial=0.0), noise), kind="stable")
    active, scale = active[rows], scale[rows]
    orthogonal, triangle, order, rank = _eliminated(np.hstack([signal[rows], np.diag(noise[rows])]))
    first = triangle[:, :rank]
    weights: Matrix = np.zeros((0, order.size))
    if rank:
        weights = linalg.solve_triangular(first, triangle[:, rank:], check_finite=False)
    kept = np.abs(np.diagonal(first))
    return Dual(
        problem,
        float(kept.max(initial=1.0) / kept.min(initial=1.0)),
        active,
        scale,
        order[:rank],
        order[rank:],
        orthogonal,
        first,
        weights,
        sorted_qr(np.vstack([weights, np.eye(weights.shape[1])])),
    )


def _row_scale(matrix: Matrix) -> Vector:
    """How large rows are whatever the sizes of columns are, in powers of 2: (m,), for rows that are not all zeros.

    |a_ij| is nearly row_i column_j: least squares in the logarithms (Curtis and Reid 1972), by alternate means.
    Rows are to be divided by it; columns keep their size, by which pivoting tells what the prior says most of.
    """
    there = matrix != 0
    logarithm = np.log2(np.abs(matrix), out=np.zeros_like(matrix), where=there)
    in_row, in_column = there.sum(axis=1), np.maximum(there.sum(axis=0), 1)
    row, column = np.zeros(matrix.shape[0]), np.zeros(matrix.shape[1])
    for _ in range(SWEEPS):
        row = (logarithm.sum(axis=1) - there @ column) / in_row
        column = (logarithm.sum(axis=0) - row @ there) / in_column
    return np.exp2(np.round(row))


def _eliminated(whole: Matrix) -> tuple[Matrix, Matrix, Indices, int]:
    """Pivoted QR, (m, n), by columns of very different size: Q, (m, rank), R, (rank, n), the order, and the rank.

    What is left of a column below its own rounding is rounding and becomes 0, so that it is not taken for a pivot
    before smaller columns that are there: there the prior speaks, and small noise must not drown in it.
    """
    rows, columns = whole.shape
    rounding = 4 * EPS * columns * np.sqrt(np.square(whole).sum(axis=0))
    orthogonal, triangle, rank = np.eye(rows), whole.copy(), 0
    order: Indices = np.arange(columns, dtype=np.intp)
    turned: Matrix
    reduced: Matrix
    pivots: Indices
    decompose: Any = linalg.qr
    while rank < min(rows, columns):
        rest = triangle[rank:, rank:]
        rest[:, np.sqrt(np.square(rest).sum(axis=0)) <= rounding[order[rank:]]] = 0.0
        if not rest.any():
            break
        turned, reduced, pivots = decompose(rest, pivoting=True, check_finite=False)
        orthogonal[:, rank:] = orthogonal[:, rank:] @ turned
        triangle[:rank, rank:] = triangle[:rank, rank:][:, pivots]
        triangle[rank:, rank:] = reduced
        order[rank:] = order[rank:][pivots]
        diagonal = np.abs(np.diagonal(reduced))
        sound = diagonal > rounding[order[rank : rank + diagonal.size]]
        rank += diagonal.size if sound.all() else max(int(np.argmin(sound)), 1)
    triangle = triangle[:rank]
    return orthogonal[:, :rank], np.where(np.abs(triangle) > rounding[order], triangle, 0.0), order, rank
