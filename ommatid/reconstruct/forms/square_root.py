"""The square-root information form, by pivoted QR of the whitened rows B = S^-1 H L stacked on the prior's identity.

Nothing is squared, so it keeps twice the digits of Cholesky. Rows are sorted by size and columns pivoted: the rounding
error of every row then stays in proportion to that row (Cox and Higham 1998, theorem 2.3), so that noise may differ
widely between measurements. If H has a null space and the noise is so small that the rounding of B outweighs the prior,
the result is wrong without a warning; the certificate has to detect it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

from ..problem import Form, NotSolvableError, Problem, check_noise, multipliers, root_variance

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class SortedQr:
    """A, (m, n), m >= n: A[rows][:, pivots] = Q R with (m, n) `orthogonal` and (n, n) `triangle`."""

    orthogonal: FloatArray
    triangle: FloatArray
    rows: Indices
    pivots: Indices

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the x that minimises |A x - b|: (m, q) to (n, q)."""
        solution = np.empty((self.pivots.size, right.shape[1]))
        projected = self.orthogonal.T @ right[self.rows]
        solution[self.pivots] = linalg.solve_triangular(self.triangle, projected, check_finite=False)
        return solution

    def inverse(self) -> FloatArray:
        """Return R^-1 with rows in the order of A's columns: a root T of (A^T A)^-1 = T T^T, (n, n)."""
        inverse = np.empty_like(self.triangle)
        lapack: Any = linalg.lapack
        inverse[self.pivots], _ = lapack.dtrtri(self.triangle)
        return inverse

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest diagonal entry of R."""
        diagonal = np.abs(np.diagonal(self.triangle))
        return float(diagonal.max(initial=1.0) / diagonal.min(initial=1.0)) if diagonal.all() else float("inf")


def sorted_qr(matrix: FloatArray) -> SortedQr:
    """Decompose A."""
    rows = np.argsort(-np.abs(matrix).max(axis=1, initial=0.0), kind="stable")
    qr: Any = linalg.qr
    orthogonal, triangle, pivots = qr(matrix[rows], mode="economic", pivoting=True, check_finite=False)
    return SortedQr(orthogonal, triangle, rows, pivots)


@dataclass(frozen=True)
class SquareRoot(Form):
    """The QR decomposition of [B; I], (M + K, K), as `normal`."""

    normal: SortedQr

    name: ClassVar[str] = "square-root"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the least-squares solution of B u = S^-1 r, u = c, and its multipliers."""
        u = self.normal.solve(np.vstack([residual / self.problem.deviation[:, None], shift]))
        return u, multipliers(self.problem, u, residual)

    def variance(self) -> FloatArray:
        """Return the diagonal of L R^-1 R^-T L^T."""
        return root_variance(self.problem, self.normal.inverse())


def square_root(problem: Problem) -> SquareRoot:
    """Factorise in square-root form. Raises NotSolvableError without noise, or beyond the range of float64."""
    check_noise(problem)
    whitened = problem.dense_matrix() / problem.deviation[:, None]
    if not np.isfinite(whitened).all():
        raise NotSolvableError("its matrix leaves the range of double precision")
    normal = sorted_qr(np.vstack([whitened, np.eye(problem.prior.dimension)]))
    return SquareRoot(problem, normal.condition, normal)
