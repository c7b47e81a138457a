"""The two residuals of the estimator's equations, in twice the precision of float64.

With c and r the right sides (`forms.form`), u and l what was found for them,

    p = c + L^T H^T l - u,    q = r - H L u - Rv l.

Both cancel almost wholly: in plain float64 little but rounding would be left of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..prior import Prior
from ..problem import Problem
from .double_double import ROUNDING, DoubleDouble, SparseRows, exact, rows_of, rows_of_dense

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class ExactResiduals:
    """A problem's matrices laid out for products in twice the precision."""

    problem: Problem

    @cached_property
    def _matrix(self) -> SparseRows:
        return rows_of(self.problem.matrix)

    @cached_property
    def _transposed(self) -> SparseRows:
        return rows_of(sparse.csr_array(self.problem.matrix.T))

    @cached_property
    def _root(self) -> tuple[SparseRows, SparseRows]:
        root = self.problem.prior.root
        return rows_of_dense(root), rows_of_dense(root.T)

    @cached_property
    def _sizes(self) -> tuple[sparse.csr_array, Prior]:
        prior = self.problem.prior
        return abs(self.problem.matrix), Prior(prior.mean, np.abs(prior.root))

    @property
    def rounding(self) -> float:
        """Relative rounding of the residuals, from the number of terms in their longest sum."""
        longest = max(self._matrix.data.shape[0], self._transposed.data.shape[0])
        return ROUNDING * (4 + longest + (0 if self.problem.prior.independent else self.problem.prior.freedoms))

    @cached_property
    def signal(self) -> Vector:
        """A size for every row of H L, at least its norm: (M,)."""
        matrix, prior = self._sizes
        return np.asarray(matrix @ np.sqrt(prior.variance))

    def observe(self, freedoms: DoubleDouble) -> DoubleDouble:
        """H L u."""
        prior = self.problem.prior
        spread = freedoms.scaled(prior.root[:, None]) if prior.independent else self._root[0].times(freedoms)
        return self._matrix.times(spread)

    def adjoint(self, measurements: DoubleDouble) -> DoubleDouble:
        """L^T H^T l."""
        prior = self.problem.prior
        seen = self._transposed.times(measurements)
        return seen.scaled(prior.root[:, None]) if prior.independent else self._root[1].times(seen)

    def recorded(self, values: Vector) -> DoubleDouble:
        """g - H f0: (M, 1)."""
        return exact(values[:, None]) - self._matrix.times(exact(self.problem.prior.mean[:, None]))

    def residuals(
        self, u: DoubleDouble, pull: DoubleDouble, shift: DoubleDouble, recorded: DoubleDouble
    ) -> tuple[DoubleDouble, DoubleDouble]:
        """p and q of the module's text, l being `pull`: (K, q) and (M, q)."""
        noise = self.problem.noise_variance[:, None]
        return shift + self.adjoint(pull) - u, recorded - self.observe(u) - pull.scaled(noise)

    def doubts(self, u: Matrix, pull: Matrix, shift: Matrix, recorded: Matrix) -> tuple[Matrix, Matrix]:
        """How far rounding may have moved p and q, from the sizes of all that is added up in them."""
        matrix, prior = self._sizes
        u, pull = np.abs(u), np.abs(pull)
        p = np.abs(shift) + prior.gather(matrix.T @ pull) + u
        q = np.abs(recorded) + matrix @ prior.spread(u) + self.problem.noise_variance[:, None] * pull
        return self.rounding * p, self.rounding * q

    def contradiction(self, recorded: Vector, u: Vector) -> float:
        """How far measurements without noise are from being met, at most: |g - H f|_i / (|g| + |H| |f|)_i.

        Rounding leaves 1e-16, measurements in float32 1e-7, and those that contradict one another or the prior more.
        """
        silent = self.problem.noise_variance == 0
        left = (self.recorded(recorded) - self.observe(exact(u[:, None]))).high[:, 0]
        matrix, prior = self._sizes
        size = np.abs(recorded) + matrix @ (np.abs(prior.mean) + prior.spread(np.abs(u)))
        return float(np.divide(np.abs(left), size, out=np.zeros_like(size), where=silent & (size > 0)).max(initial=0.0))
