"""Dual form: the solution (u, w) of H L u + S w = r with the least norm, by pivoted QR of [H L, S].

It divides by neither S nor L, so it admits measurements without noise, known pixels, and noise that differs widely
between measurements. Pivoting splits (u, w) into basic variables, which the measurements determine, and free ones t,
which the prior determines: basic = y - W t with W = R1^-1 R2. Small variances are then sums of small numbers, not
differences of large ones. It is the most expensive form: cubic in measurements plus unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

from ..problem import Form, Problem, root_variance
from .square_root import Indices, SortedQr, sorted_qr

EPS = float(np.finfo(np.float64).eps)
SCALING_SWEEPS = 30


@dataclass(frozen=True)
class Dual(Form):
    """Rows with signal are `active`, divided by `scale`; their [H L, S] is Q [R1 R2] in the order `basic`, `free`.

    orthogonal : (m, rank) Q
    triangle : (rank, rank) R1;  weights : (rank, K + m - rank) W
    normal : the QR decomposition of [W; I]
    """

    active: Indices
    scale: FloatArray
    basic: Indices
    free: Indices
    orthogonal: FloatArray
    triangle: FloatArray
    weights: FloatArray
    normal: SortedQr

    name: ClassVar[str] = "dual"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the u of the (u, w) nearest to (c, 0), and l from the basic columns of (H L, S)^T l = (u - c, w)."""
        dimension, rank = self.problem.prior.dimension, self.basic.size
        scaled = residual[self.active] / self.scale[:, None]
        target = np.zeros((dimension + self.active.size, shift.shape[1]))
        target[:dimension] = shift
        particular = linalg.solve_triangular(self.triangle, self.orthogonal.T @ scaled, check_finite=False)
        free = self.normal.solve(np.vstack([particular - target[self.basic], target[self.free]]))
        solution = np.empty_like(target)
        solution[self.free] = free
        solution[self.basic] = particular - self.weights @ free
        change = (solution - target)[self.basic]
        multiplier = np.zeros_like(residual)
        if rank:
            rows = self.orthogonal @ linalg.solve_triangular(self.triangle, change, trans="T", check_finite=False)
            multiplier[self.active] = rows / self.scale[:, None]
        noise = self.problem.noise_variance
        without_signal = np.setdiff1d(np.flatnonzero(noise > 0), self.active)
        multiplier[without_signal] = residual[without_signal] / noise[without_signal, None]
        return solution[:dimension], multiplier

    def variance(self) -> FloatArray:
        """Return the diagonal of L T T^T L^T with T = [I; -W] R^-1 in the rows of u."""
        inverse, dimension = self.normal.inverse(), self.problem.prior.dimension
        root = np.zeros((dimension + self.active.size, self.free.size))
        root[self.free] = inverse
        root[self.basic] = -self.weights @ inverse
        return root_variance(self.problem, root[:dimension])


def dual(problem: Problem) -> Dual:
    """Factorise in dual form."""
    dense = problem.dense_matrix()
    active = np.flatnonzero(dense.any(axis=1))
    scale = _row_scale(dense[active])
    signal, noise = dense[active] / scale[:, None], problem.deviation[active] / scale
    rows = np.argsort(-np.maximum(np.abs(signal).max(axis=1, initial=0.0), noise), kind="stable")
    active, scale = active[rows], scale[rows]
    orthogonal, triangle, order, rank = _pivoted_qr(np.hstack([signal[rows], np.diag(noise[rows])]))
    first = triangle[:, :rank]
    weights: FloatArray = np.zeros((0, order.size))
    if rank:
        weights = linalg.solve_triangular(first, triangle[:, rank:], check_finite=False)
    diagonal = np.abs(np.diagonal(first))
    return Dual(
        problem,
        float(diagonal.max(initial=1.0) / diagonal.min(initial=1.0)),
        active,
        scale,
        order[:rank],
        order[rank:],
        orthogonal,
        first,
        weights,
        sorted_qr(np.vstack([weights, np.eye(weights.shape[1])])),
    )


def _row_scale(matrix: FloatArray) -> FloatArray:
    """Return the size of every row independent of column sizes, as powers of 2: (m,); rows must not be all zeros.

    Fits |a_ij| = row_i column_j by least squares in the logarithms (Curtis and Reid 1972), by alternating means.
    Only rows are scaled; pivoting relies on column sizes to find the directions of largest prior variance.
    """
    nonzero = matrix != 0
    logarithm = np.log2(np.abs(matrix), out=np.zeros_like(matrix), where=nonzero)
    in_row, in_column = nonzero.sum(axis=1), np.maximum(nonzero.sum(axis=0), 1)
    row, column = np.zeros(matrix.shape[0]), np.zeros(matrix.shape[1])
    for _ in range(SCALING_SWEEPS):
        row = (logarithm.sum(axis=1) - nonzero @ column) / in_row
        column = (logarithm.sum(axis=0) - row @ nonzero) / in_column
    return np.exp2(np.round(row))


def _pivoted_qr(matrix: FloatArray) -> tuple[FloatArray, FloatArray, Indices, int]:
    """Pivoted QR, (m, n), of columns of very different size: Q, (m, rank), R, (rank, n), column order and rank.

    A remaining column below its own rounding error is set to 0, so that it is not chosen as a pivot before smaller but
    significant columns; otherwise rounding errors would replace the prior in these directions.
    """
    rows, columns = matrix.shape
    rounding = 4 * EPS * columns * np.sqrt(np.square(matrix).sum(axis=0))
    orthogonal, triangle, rank = np.eye(rows), matrix.copy(), 0
    order: Indices = np.arange(columns, dtype=np.intp)
    rotation: FloatArray
    reduced: FloatArray
    pivots: Indices
    qr: Any = linalg.qr
    while rank < min(rows, columns):
        rest = triangle[rank:, rank:]
        rest[:, np.sqrt(np.square(rest).sum(axis=0)) <= rounding[order[rank:]]] = 0.0
        if not rest.any():
            break
        rotation, reduced, pivots = qr(rest, pivoting=True, check_finite=False)
        orthogonal[:, rank:] = orthogonal[:, rank:] @ rotation
        triangle[:rank, rank:] = triangle[:rank, rank:][:, pivots]
        triangle[rank:, rank:] = reduced
        order[rank:] = order[rank:][pivots]
        diagonal = np.abs(np.diagonal(reduced))
        significant = diagonal > rounding[order[rank : rank + diagonal.size]]
        rank += diagonal.size if significant.all() else max(int(np.argmin(significant)), 1)
    triangle = triangle[:rank]
    return orthogonal[:, :rank], np.where(np.abs(triangle) > rounding[order], triangle, 0.0), order, rank
