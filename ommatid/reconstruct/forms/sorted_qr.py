"""Least squares by a QR decomposition with rows sorted by size and columns pivoted.

The rounding error of every row stays in proportion to that row (Cox and Higham 1998, theorem 2.3), so rows of very
different size, such as measurements with very different noise, do not degrade one another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

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
