"""Information form: Cholesky of I + B^T B with B = S^-1 H L, the smaller matrix if unknowns are fewer.

Fast, and accurate to ten digits or more if H has full rank. With a null space and little noise the identity is lost in
the rounding of B^T B; digits are lost in proportion to the ratio of prior to noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..gram import gram
from ..problem import Problem
from .cholesky import Factor, factorise_positive
from .form import Form, NotSolvableError, check_noise, multipliers, whitened_matrix


@dataclass(frozen=True)
class Information(Form):
    """I + B^T B, scaled and factorised."""

    factor: Factor

    name: ClassVar[str] = "information"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u = (I + B^T B)^-1 (c + L^T H^T Rv^-1 r) and its multipliers."""
        u = self.factor.solve(shift + self.problem.adjoint(residual / self.problem.noise_variance[:, None]))
        return u, multipliers(self.problem, u, residual)

    @cached_property
    def inverse(self) -> FloatArray:
        """(I + B^T B)^-1: (K, K)."""
        return self.factor.inverse()

    def variance(self) -> FloatArray:
        """Return the diagonal of L (I + B^T B)^-1 L^T."""
        if self.problem.prior.independent:
            return self.problem.prior.variance * np.diagonal(self.inverse)
        root = self.problem.prior.root
        return np.maximum(np.einsum("ij,ij->i", root @ self.inverse, root), 0.0)

    def pixel_solutions(self, pixels: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Take u from the inverse, which costs a third of solving for every pixel."""
        prior = self.problem.prior
        root = prior.root[pixels]
        u = self.inverse[:, pixels] * root if prior.independent else self.inverse @ root.T
        return u, multipliers(self.problem, u, np.zeros((self.problem.measurements, u.shape[1])))


def information(problem: Problem) -> Information:
    """Factorise in information form. Raises NotSolvableError without noise, or if float64 does not suffice."""
    check_noise(problem)
    if problem.prior.independent:
        scaled = sparse.csr_array(problem.matrix.multiply(1 / problem.deviation[:, None]))
        scaled = sparse.csr_array(scaled.multiply(problem.prior.root[None, :]))
        normal = gram(scaled)
    else:
        whitened = whitened_matrix(problem)
        normal = whitened.T @ whitened
    normal[np.diag_indices(normal.shape[0])] += 1.0
    if not np.isfinite(normal).all():
        raise NotSolvableError("the squares of its matrix leave the range of double precision")
    factor, condition = factorise_positive(normal)
    return Information(problem, condition, factor)
