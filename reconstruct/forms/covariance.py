"""Covariance form: Cholesky of H P0 H^T + Rv, the smaller matrix where measurements are fewer than unknowns.

Rows are scaled to a unit diagonal first. It needs no inverse of P0 or Rv, but forms squares: with noise far below the
prior it keeps half the digits at best. I - A H is a difference here; its squares, together with those of A, still
make a covariance that cannot be negative (Joseph's form of Eq. 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy import sparse

from ..problem import Problem
from .cholesky import Factor, factorise_positive
from .form import Form, Matrix, Vector


@dataclass(frozen=True)
class Covariance(Form):
    """C = H P0 H^T + Rv, scaled and factorised."""

    factor: Factor

    name: ClassVar[str] = "covariance"

    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """l = C^-1 (r - H L c), u = c + L^T H^T l."""
        multiplier = self.factor.solve(residual - self.problem.observe(shift))
        return shift + self.problem.adjoint(multiplier), multiplier

    @cached_property
    def _shrinkage(self) -> tuple[Matrix, Matrix]:
        observed = self.problem.observed()
        gain = self.factor.solve(observed)
        return np.eye(observed.shape[1]) - observed.T @ gain, gain

    def variance(self) -> Vector:
        """The diagonal of (I - A H) P0 (I - A H)^T + A Rv A^T."""
        defect, gain = self._shrinkage
        spread = self.problem.prior.spread
        return np.square(spread(defect)).sum(axis=1) + np.square(spread(gain.T * self.problem.deviation)).sum(axis=1)


def covariance(problem: Problem) -> Covariance:
    """Factorise in covariance form. Raises NotSolvableError where the matrix is not positive definite in float64."""
    if problem.prior.independent:
        half = sparse.csr_array(problem.matrix.multiply(problem.prior.root[None, :]))
        matrix = np.asarray((half @ half.T).toarray())
    else:
        observed = problem.observed()
        matrix = observed @ observed.T
    matrix[np.diag_indices(problem.measurements)] += problem.noise_variance
    factor, condition = factorise_positive(matrix)
    return Covariance(problem, condition, factor)
