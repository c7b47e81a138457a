"""Interface of a factorised problem (Wood et al. 2005, Eq. 4 and 5).

All forms solve one linear system. With f = f0 + L u and multipliers l,

    u - L^T H^T l = c,    H L u + Rv l = r.

With c = 0 and r = g - H f0, u gives the estimate. With r = 0 and c = L^T z, L u is the posterior covariance times z,
and -l is A^T z. The forms differ in the matrix they factorise, in cost, and in sensitivity to rounding.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray

from ..problem import Problem


class NotSolvableError(Exception):
    """The form cannot factorise the problem in float64; another form may."""


@dataclass(frozen=True)
class Form(ABC):
    """A factorised problem. `condition` is the condition number of the factorised matrix, in the 1- or 2-norm."""

    problem: Problem
    condition: float

    name: ClassVar[str]

    @abstractmethod
    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve the system above for c = `shift`, (K, q), and r = `residual`, (M, q): u, (K, q), and l, (M, q)."""

    @abstractmethod
    def variance(self) -> FloatArray:
        """Posterior variance of every pixel if prior and noise are as assumed: (N,), never negative."""

    def pixel_solutions(self, pixels: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Solve for c = L^T e_i, r = 0 of each pixel i: u, (K, q), and l = -A^T e_i, (M, q).

        |u|^2 is the prior's part of Eq. 5.
        """
        return self.solve(self.problem.pixel_shift(pixels), np.zeros((self.problem.measurements, pixels.size)))

    def gain(self, residual: FloatArray) -> FloatArray:
        """Apply A of Eq. 4 to residuals: (M,) to (N,), or (M, q) to (N, q)."""
        block = residual[:, None] if residual.ndim == 1 else residual
        u, _ = self.solve(np.zeros((self.problem.prior.dimension, block.shape[1])), block)
        return self.problem.prior.apply_root(u).reshape(self.problem.unknowns, *residual.shape[1:])


def check_noise(problem: Problem) -> None:
    """Raise NotSolvableError if a measurement has no noise."""
    if not problem.noisy:
        raise NotSolvableError("it needs noise in every measurement")


def multipliers(problem: Problem, u: FloatArray, residual: FloatArray | float) -> FloatArray:
    """Return l = Rv^-1 (r - H L u): (M, q); needs noise in every measurement."""
    return (residual - problem.forward(u)) / problem.noise_variance[:, None]


def root_variance(problem: Problem, root: FloatArray) -> FloatArray:
    """Return the diagonal of L T T^T L^T for a root T, (K, q): (N,), as sums of squares."""
    return np.square(problem.prior.apply_root(root)).sum(axis=1)
