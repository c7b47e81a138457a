"""Least squares by a QR decomposition whose rows are sorted by size and whose columns are pivoted.

So the rounding of every row stays in proportion to that row (Cox and Higham 1998, theorem 2.3): rows of very different
size, such as measurements of very different noise, do one another no harm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from .form import Matrix

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class SortedQr:
    """A, (m, n), m >= n: A[rows][:, pivots] = Q R with (m, n) `orthogonal` and (n, n) `triangle`."""

    orthogonal: Matrix
    triangle: Matrix
    rows: Indices
    pivots: Indices

    def solve(self, right: Matrix) -> Matrix:
        """The x of least |A x - b|: (m, q) to (n, q)."""
        solved = np.empty((self.pivots.size, right.shape[1]))
        projected = self.orthogonal.T @ right[self.rows]
        solved[self.pivots] = linalg.solve_triangular(self.triangle, projected, check_finite=False)
        return solved

    def inverse(self) -> Matrix:
        """R^-1 with its rows where the columns of A were: a root T of (A^T A)^-1 = T T^T, (n, n)."""
        inverse = np.empty_like(self.triangle)
        lapack: Any = linalg.lapack
        inverse[self.pivots], _ = lapack.dtrtri(self.triangle)
        return inverse

    @property
    def condition(self) -> float:
        """Largest over smallest diagonal entry of R."""
        diagonal = np.abs(np.diagonal(self.triangle))
        return float(diagonal.max(initial=1.0) / diagonal.min(initial=1.0)) if diagonal.all() else float("inf")


def sorted_qr(matrix: Matrix) -> SortedQr:
    """Decompose A."""
    rows = np.argsort(-np.abs(matrix).max(axis=1, initial=0.0), kind="stable")
    decompose: Any = linalg.qr
    orthogonal, triangle, pivots = decompose(matrix[rows], mode="economic", pivoting=True, check_finite=False)
    return SortedQr(orthogonal, triangle, rows, pivots)
