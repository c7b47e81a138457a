"""Truncated singular value decomposition of B = S^-1 H L: one decomposition per geometry serves every noise level.

Singular values below the rounding error of the largest are set to 0, their exact value if H has a null space, so no
noise level is too small. The form is unsuitable for noise that differs widely between measurements: where the rounding
of the largest singular value outweighs the prior, the information in small rows is lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from ommatid.runtime.arrays import FloatArray

from ..problem import Problem
from .form import Form, root_variance, whitened_matrix

TRUNCATION = 4  # times eps, the longer side and the largest singular value: smaller ones are set to 0


@dataclass(frozen=True)
class Svd(Form):
    """B = U diag(s) V^T: (M, R) `left`, (K,) `values` (0 beyond the rank R) and (K, K) `right`, the columns of V."""

    left: FloatArray
    values: FloatArray
    right: FloatArray

    name: ClassVar[str] = "svd"

    @property
    def rank(self) -> int:
        """R, the rank of B."""
        return int(self.left.shape[1])

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u = V (s U^T S^-1 r + V^T c) / (1 + s^2) and its multipliers."""
        deviation = self.problem.deviation[:, None]
        s, rank = self.values[:, None], self.rank
        white = residual / deviation
        from_data = self.left.T @ white
        from_prior = self.right.T @ shift
        weights = from_prior.copy()
        weights[:rank] += s[:rank] * from_data
        weights /= 1 + s**2
        # S l = (I + B B^T)^-1 (S^-1 r - B c); the part outside the span of U is unchanged.
        inside = (from_data - s[:rank] * from_prior[:rank]) / (1 + s[:rank] ** 2)
        multiplier = self.left @ (inside - from_data) + white
        return self.right @ weights, multiplier / deviation

    @cached_property
    def _modes(self) -> FloatArray:
        """L V: (N, K)."""
        return self.problem.prior.apply_root(self.right)

    def variance(self) -> FloatArray:
        """Return the diagonal of L V (1 + s^2)^-1 V^T L^T."""
        return root_variance(self.problem, self.right / np.sqrt(1 + self.values**2))

    def with_noise_scaled(self, factor: float) -> Svd:
        """Return the form for noise variances multiplied by `factor`."""
        problem = replace(self.problem, noise_variance=factor * self.problem.noise_variance)
        values = self.values / np.sqrt(factor)
        return replace(self, problem=problem, values=values, condition=float(np.sqrt(1 + values[0] ** 2)))

    def resolved(self) -> FloatArray:
        """Return the diagonal of A H in the limit of no noise: (N,)."""
        rank, problem = self.rank, self.problem
        responses = (problem.matrix.T @ (self.left / problem.deviation[:, None])).T
        return np.einsum("ir,ri->i", self._modes[:, :rank] / self.values[:rank], responses)

    def expected_variance(self, expected: float, actual: float) -> FloatArray:
        """Return Eq. 5 for an estimator that assumes `expected` times Rv while the noise is `actual` times Rv: (N,).

        expected : above 0, or 0 for the limit of an estimator that assumes no noise
        """
        s2 = self.values**2
        if expected > 0:
            prior, noise = (expected / (expected + s2)) ** 2, s2 * actual / (expected + s2) ** 2
        else:
            measured = s2 > 0
            prior = np.where(measured, 0.0, 1.0)
            noise = np.divide(actual, s2, out=np.zeros_like(s2), where=measured)
        return np.square(self._modes) @ (prior + noise)


def svd(problem: Problem) -> Svd:
    """Decompose B. Raises NotSolvableError if a measurement has no noise or values exceed the range of float64."""
    whitened = whitened_matrix(problem)
    measurements, dimension = whitened.shape
    qr: Any = linalg.qr
    decompose: Any = linalg.svd
    left: FloatArray
    singular: FloatArray
    transposed: FloatArray
    if measurements > dimension:
        orthogonal, triangle = qr(whitened, mode="economic", overwrite_a=True, check_finite=False)
        left, singular, transposed = decompose(triangle, check_finite=False)
        left = orthogonal @ left
    else:
        left, singular, transposed = decompose(whitened, full_matrices=True, overwrite_a=True, check_finite=False)
    largest = float(singular.max(initial=0.0))
    least = TRUNCATION * np.finfo(np.float64).eps * max(measurements, dimension) * largest
    rank = int(np.sum(singular > least))
    values = np.zeros(dimension)
    values[:rank] = singular[:rank]
    condition = float(np.hypot(1.0, largest))
    return Svd(problem, condition, np.ascontiguousarray(left[:, :rank]), values, transposed.T)
