"""Truncated singular value decomposition of B = S^-1 H L: once a geometry, then every noise level for nothing.

Singular values below the rounding of the largest are taken for zeros, which is what they are where H leaves a null
space. Then no noise is too small. What it cannot do is noise of very different size from one measurement to the next:
where the largest singular value times the rounding outweighs the prior, it loses what the small rows say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from ..problem import Problem
from .form import Form, Matrix, NotSolvableError, Vector, root_variance

TRUNCATION = 4  # singular values below this times eps times the larger side times the largest are zeros


@dataclass(frozen=True)
class Svd(Form):
    """B = U diag(s) V^T: (M, R) `left`, (K,) `values` (0 beyond the rank R) and (K, K) `right`, the columns of V."""

    left: Matrix
    values: Vector
    right: Matrix

    name: ClassVar[str] = "svd"

    @property
    def rank(self) -> int:
        """R: the rank of B."""
        return int(self.left.shape[1])

    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """u = V (s U^T S^-1 r + V^T c) / (1 + s^2)."""
        deviation = self.problem.deviation[:, None]
        s, rank = self.values[:, None], self.rank
        white = residual / deviation
        from_data = self.left.T @ white
        from_prior = self.right.T @ shift
        weights = from_prior.copy()
        weights[:rank] += s[:rank] * from_data
        weights /= 1 + s**2
        # S l = (I + B B^T)^-1 (S^-1 r - B c); what U does not span stays as it is.
        inside = (from_data - s[:rank] * from_prior[:rank]) / (1 + s[:rank] ** 2)
        multiplier = self.left @ (inside - from_data) + white
        return self.right @ weights, multiplier / deviation

    @cached_property
    def _pixels(self) -> Matrix:
        return self.problem.prior.spread(self.right)

    def variance(self) -> Vector:
        """The diagonal of L V (1 + s^2)^-1 V^T L^T."""
        return root_variance(self.problem, self.right / np.sqrt(1 + self.values**2))

    def at(self, factor: float) -> Svd:
        """The same for noise of `factor` times the variance in every measurement."""
        problem = replace(self.problem, noise_variance=factor * self.problem.noise_variance)
        values = self.values / np.sqrt(factor)
        return replace(self, problem=problem, values=values, condition=float(np.sqrt(1 + values[0] ** 2)))

    def resolved(self) -> Vector:
        """The diagonal of A H in the limit without noise: (N,)."""
        rank, problem = self.rank, self.problem
        seen = (problem.matrix.T @ (self.left / problem.deviation[:, None])).T
        return np.einsum("ir,ri->i", self._pixels[:, :rank] / self.values[:rank], seen)

    def expected_variance(self, expected: float, actual: float) -> Vector:
        """Eq. 5 where the estimator expects `expected` times Rv and the noise is `actual` times Rv: (N,).

        expected : above 0, or 0 for the limit in which the estimator believes what it sees
        """
        s2 = self.values**2
        if expected > 0:
            prior, noise = (expected / (expected + s2)) ** 2, s2 * actual / (expected + s2) ** 2
        else:
            seen = s2 > 0
            prior = np.where(seen, 0.0, 1.0)
            noise = np.divide(actual, s2, out=np.zeros_like(s2), where=seen)
        return np.square(self._pixels) @ (prior + noise)


def svd(problem: Problem) -> Svd:
    """Decompose. Raises NotSolvableError where a measurement has no noise or numbers leave float64's range."""
    if not problem.noisy:
        raise NotSolvableError("it needs noise in every measurement")
    whitened = problem.whitened()
    if not np.isfinite(whitened).all():
        raise NotSolvableError("its matrix leaves the range of double precision")
    measurements, freedoms = whitened.shape
    qr: Any = linalg.qr
    decompose: Any = linalg.svd
    left: Matrix
    found: Vector
    transposed: Matrix
    if measurements > freedoms:
        orthogonal, triangle = qr(whitened, mode="economic", overwrite_a=True, check_finite=False)
        left, found, transposed = decompose(triangle, check_finite=False)
        left = orthogonal @ left
    else:
        left, found, transposed = decompose(whitened, full_matrices=True, overwrite_a=True, check_finite=False)
    largest = float(found.max(initial=0.0))
    least = TRUNCATION * np.finfo(np.float64).eps * max(measurements, freedoms) * largest
    rank = int(np.sum(found > least))
    values = np.zeros(freedoms)
    values[:rank] = found[:rank]
    condition = float(np.hypot(1.0, largest))
    return Svd(problem, condition, np.ascontiguousarray(left[:, :rank]), values, transposed.T)
