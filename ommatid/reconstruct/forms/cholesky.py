"""The forms by Cholesky: of H P0 H^T + Rv, (M, M), and of I + B^T B with B = S^-1 H L, (K, K).

Either matrix is scaled to a unit diagonal first. H is squared in both, so that with noise far below the prior at best
half the digits remain. The covariance form takes the smaller matrix if measurements are fewer than unknowns, and needs
no inverse of P0 or Rv; its variances come from Joseph's form of Eq. 5, a sum of squares, because the difference
I - A H alone could make them negative. The information form takes the smaller matrix if unknowns are fewer. It is fast,
and accurate to ten digits or more if H has full rank. With a null space and little noise the identity is lost in the
rounding of B^T B; digits are lost in proportion to the ratio of prior to noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray

from ..problem import Form, NotSolvableError, Problem, check_noise, gram, multipliers


@dataclass(frozen=True)
class Factor:
    """C C^T = D^-1 A D^-1 with D^2 the diagonal of A: (n, n) lower `root` and (n,) `scale`, the diagonal of D."""

    root: FloatArray
    scale: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        """Return A^-1 b: (n, q) to (n, q)."""
        scaled = right / self.scale[:, None]
        solution: FloatArray = linalg.cho_solve((self.root, True), scaled, overwrite_b=True, check_finite=False)
        return np.divide(solution, self.scale[:, None], out=solution)

    def inverse(self) -> FloatArray:
        """Return A^-1: (n, n)."""
        inverse, _ = linalg.lapack.dpotri(self.root, lower=1)
        lower = np.tril(inverse)
        full = lower + np.tril(lower, -1).T
        return full / self.scale[:, None] / self.scale


def factorise_positive(matrix: FloatArray) -> tuple[Factor, float]:
    """Factorise A, (n, n), in place; return the factor and the 1-norm condition number of the scaled matrix.

    Raises NotSolvableError if A is not positive definite in float64.
    """
    scale = np.sqrt(np.diagonal(matrix))
    if not (scale > 0).all():
        raise NotSolvableError("a measurement has neither signal nor noise")
    matrix /= scale[:, None]
    matrix /= scale
    norm = float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    try:
        root = linalg.cholesky(matrix, lower=True, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError as error:
        raise NotSolvableError("its matrix is not positive definite in double precision") from error
    reciprocal, _ = linalg.lapack.dpocon(root, norm, uplo="L") if scale.size else (1.0, 0)
    # The last digits of LAPACK's estimate depend on memory alignment; rounding makes runs reproducible.
    return Factor(root, scale), float(f"{1 / reciprocal:.6g}") if reciprocal > 0 else float("inf")


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
    def _variance(self) -> FloatArray:
        dense, root = self.problem.dense_matrix(), self.problem.prior.apply_root
        gain = self.factor.solve(dense)
        defect = np.eye(dense.shape[1]) - dense.T @ gain
        return np.square(root(defect)).sum(axis=1) + np.square(root(gain.T * self.problem.deviation)).sum(axis=1)

    def variance(self) -> FloatArray:
        """Return the diagonal of (I - A H) P0 (I - A H)^T + A Rv A^T."""
        return self._variance


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


@dataclass(frozen=True)
class Information(Form):
    """I + B^T B, scaled and factorised."""

    factor: Factor

    name: ClassVar[str] = "information"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u = (I + B^T B)^-1 (c + L^T H^T Rv^-1 r) and l = Rv^-1 (r - H L u)."""
        u = self.factor.solve(shift + self.problem.adjoint(residual / self.problem.noise_variance[:, None]))
        return u, multipliers(self.problem, u, residual)

    @cached_property
    def inverse(self) -> FloatArray:
        """(I + B^T B)^-1: (K, K)."""
        return self.factor.inverse()

    def variance(self) -> FloatArray:
        """Return the diagonal of L (I + B^T B)^-1 L^T."""
        return np.maximum(self.problem.prior.variance_of(self.inverse), 0.0)

    def pixel_solutions(self, pixels: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Take u from the inverse, which costs a third of solving for every pixel."""
        prior = self.problem.prior
        u = self.inverse[:, pixels] * prior.root[pixels] if prior.independent else self.inverse @ prior.root[pixels].T
        return u, multipliers(self.problem, u, 0.0)


def information(problem: Problem) -> Information:
    """Factorise in information form. Raises NotSolvableError without noise, or if float64 does not suffice."""
    check_noise(problem)
    if problem.prior.independent:
        scaled = sparse.csr_array(problem.matrix.multiply(1 / problem.deviation[:, None]))
        scaled = sparse.csr_array(scaled.multiply(problem.prior.root[None, :]))
        normal = gram(scaled)
    else:
        whitened = problem.dense_matrix() / problem.deviation[:, None]
        normal = whitened.T @ whitened
    normal[np.diag_indices(normal.shape[0])] += 1.0
    if not np.isfinite(normal).all():
        raise NotSolvableError("the squares of its matrix leave the range of double precision")
    factor, condition = factorise_positive(normal)
    return Information(problem, condition, factor)
