"""Covariance form: Cholesky of H P0 H^T + Rv, the smaller matrix if measurements are fewer than unknowns.

Rows are scaled to a unit diagonal first. No inverse of P0 or Rv is needed, but H is squared: with noise far below the
prior at best half the digits remain. Variances come from Joseph's form of Eq. 5, a sum of squares, because the
difference I - A H alone could make them negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..gram import gram
from ..problem import Problem
from .cholesky import Factor, factorise_positive
from .form import Form


@dataclass(frozen=True)
class Covariance(Form):
    """C = H P0 H^T + Rv, scaled and factorised."""

    factor: Factor

    name: ClassVar[str] = "covariance"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u = c + L^T H^T l and l = C^-1 (r - H L c)."""
        multiplier = self.factor.solve(residual - self.problem.forward(shift))
        return shift + self.problem.adjoint(multiplier), multiplier

    @cached_property
    def _defect_and_gain(self) -> tuple[FloatArray, FloatArray]:
        """I - L^T H^T C^-1 H L, (K, K), and C^-1 H L, (M, K)."""
        dense = self.problem.dense_matrix()
        gain = self.factor.solve(dense)
        return np.eye(dense.shape[1]) - dense.T @ gain, gain

    def variance(self) -> FloatArray:
        """Return the diagonal of (I - A H) P0 (I - A H)^T + A Rv A^T."""
        defect, gain = self._defect_and_gain
        root = self.problem.prior.apply_root
        return np.square(root(defect)).sum(axis=1) + np.square(root(gain.T * self.problem.deviation)).sum(axis=1)


def covariance(problem: Problem) -> Covariance:
    """Factorise in covariance form. Raises NotSolvableError if the matrix is not positive definite in float64."""
    if problem.prior.independent:
        scaled = sparse.csr_array(problem.matrix.multiply(problem.prior.root[None, :]))
        matrix = gram(sparse.csr_array(scaled.T))
    else:
        dense = problem.dense_matrix()
        matrix = dense @ dense.T
    matrix[np.diag_indices(problem.measurements)] += problem.noise_variance
    factor, condition = factorise_positive(matrix)
    return Covariance(problem, condition, factor)
