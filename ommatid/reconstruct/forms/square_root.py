"""The square-root forms, by orthogonal triangularisation: nothing is squared, so they keep twice the digits.

The information form stacks the whitened rows B = S^-1 H L on the identity of the prior. Rows are sorted by size and
columns pivoted: the rounding error of every row then stays in proportion to that row (Cox and Higham 1998, theorem
2.3), so that noise may differ widely between measurements. If H has a null space and the noise is so small that the
rounding of B outweighs the prior, the result is wrong without a warning; the certificate has to detect it.

The covariance form, or array form, needs the inverse of neither P0 nor Rv. One triangularisation (Kailath, Sayed and
Hassibi 2000, section 12.3)

    [ S      0 ]         [ C  K ]
    [ (HL)^T I ]  = Q    [ 0  T ]

gives the root C of H P0 H^T + Rv, the gain as K^T C^-T, and a root T^T of the posterior covariance of u. T is rounded
relative to the prior, so posterior variances far below the prior's lose half their digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

from ..problem import Problem
from .form import Form, NotSolvableError, multipliers, root_variance, whitened_matrix

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
class SquareRootInformation(Form):
    """The QR decomposition of [B; I], (M + K, K), as `normal`."""

    normal: SortedQr

    name: ClassVar[str] = "square-root-information"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the least-squares solution of B u = S^-1 r, u = c, and its multipliers."""
        u = self.normal.solve(np.vstack([residual / self.problem.deviation[:, None], shift]))
        return u, multipliers(self.problem, u, residual)

    def variance(self) -> FloatArray:
        """Return the diagonal of L R^-1 R^-T L^T."""
        return root_variance(self.problem, self.normal.inverse())


def square_root_information(problem: Problem) -> SquareRootInformation:
    """Factorise in square-root information form. Raises NotSolvableError if a measurement has no noise."""
    normal = sorted_qr(np.vstack([whitened_matrix(problem), np.eye(problem.prior.dimension)]))
    return SquareRootInformation(problem, normal.condition, normal)


@dataclass(frozen=True)
class SquareRootCovariance(Form):
    """C, (M, M) upper, K, (M, K), and T, (K, K) upper, of the array above; rows are divided by (M,) `scale`."""

    innovation: FloatArray
    cross: FloatArray
    posterior: FloatArray
    scale: FloatArray

    name: ClassVar[str] = "square-root-covariance"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u = c + K^T C^-T (r - H L c) and l = C^-1 C^-T (r - H L c)."""
        scaled = (residual - self.problem.forward(shift)) / self.scale[:, None]
        white = linalg.solve_triangular(self.innovation, scaled, trans="T", check_finite=False)
        multiplier = linalg.solve_triangular(self.innovation, white, check_finite=False)
        return shift + self.cross.T @ white, multiplier / self.scale[:, None]

    def variance(self) -> FloatArray:
        """Return the diagonal of L T^T T L^T."""
        return root_variance(self.problem, self.posterior.T)


def square_root_covariance(problem: Problem) -> SquareRootCovariance:
    """Factorise in array form. Raises NotSolvableError if measurements without noise are linearly dependent."""
    dense = problem.dense_matrix()
    measurements, dimension = dense.shape
    scale = np.hypot(np.sqrt(np.square(dense).sum(axis=1)), problem.deviation)
    if not (scale > 0).all():
        raise NotSolvableError("a measurement has neither signal nor noise")
    array = np.zeros((measurements + dimension, measurements + dimension))
    array[:measurements, :measurements] = np.diag(problem.deviation / scale)
    array[measurements:, :measurements] = dense.T / scale
    array[measurements:, measurements:] = np.eye(dimension)
    qr: Any = linalg.qr
    triangle: FloatArray = qr(array, mode="r", overwrite_a=True, check_finite=False)[0]
    innovation = triangle[:measurements, :measurements]
    diagonal = np.abs(np.diagonal(innovation))
    condition = float(diagonal.max(initial=1.0) / max(diagonal.min(initial=1.0), np.finfo(np.float64).tiny))
    if condition * np.finfo(np.float64).eps * measurements > 1:
        raise NotSolvableError("measurements with too little noise are linearly dependent")
    cross, posterior = triangle[:measurements, measurements:], triangle[measurements:, measurements:]
    return SquareRootCovariance(problem, condition, innovation, cross, posterior, scale)
