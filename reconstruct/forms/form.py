"""What every form of the estimator can do (Wood et al., Eq. 4 and Eq. 5).

One linear system holds them all. With f = f0 + L u and multipliers l,

    u - L^T H^T l = c,    H L u + Rv l = r.

With c = 0 and r = g - H f0 its u is the estimate; with r = 0 and c = L^T z, L u is the posterior covariance times z,
and -l is A^T z. The forms differ in how they factorise it, in what they cost, and in what rounding does to them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..problem import Problem

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class NotSolvableError(Exception):
    """This form cannot factorise this problem in float64; another one may."""


@dataclass(frozen=True)
class Form(ABC):
    """A factorised problem. `condition` is that of the matrix that was factorised, in the 1 or 2-norm."""

    problem: Problem
    condition: float

    name: ClassVar[str]

    @abstractmethod
    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """Solve the system above for c = `shift`, (K, q), and r = `residual`, (M, q): u, (K, q), and l, (M, q)."""

    @abstractmethod
    def variance(self) -> Vector:
        """The diagonal of the posterior covariance where prior and noise are what was expected: (N,), never below 0."""

    def columns(self, pixels: NDArray[np.intp]) -> tuple[Matrix, Matrix]:
        """For some pixels, c = L^T e_i, r = 0: u, (K, q), with |u|^2 the prior's part of Eq. 5, and l = -A^T e_i."""
        unit = np.zeros((self.problem.unknowns, pixels.size))
        unit[pixels, np.arange(pixels.size)] = 1.0
        return self.solve(self.problem.prior.gather(unit), np.zeros((self.problem.measurements, pixels.size)))

    def gain(self, residual: Matrix) -> Matrix:
        """A r of Eq. 4: (M,) to (N,), or (M, q) to (N, q) for many at once."""
        block = _block(residual)
        u, _ = self.solve(np.zeros((self.problem.prior.freedoms, block.shape[1])), block)
        return self.problem.prior.spread(u).reshape(self.problem.unknowns, *residual.shape[1:])

    def covariance(self, image: Matrix) -> Matrix:
        """The posterior covariance times z: (N,) to (N,), or (N, q) to (N, q)."""
        block = _block(image)
        u, _ = self.solve(self.problem.prior.gather(block), np.zeros((self.problem.measurements, block.shape[1])))
        return self.problem.prior.spread(u).reshape(image.shape)


def _block(values: Matrix) -> Matrix:
    return values[:, None] if values.ndim == 1 else values


def multipliers(problem: Problem, u: Matrix, residual: Matrix) -> Matrix:
    """l = Rv^-1 (r - H L u): (M, q), where every measurement has noise."""
    return (residual - problem.observe(u)) / problem.noise_variance[:, None]


def root_variance(problem: Problem, root: Matrix) -> Vector:
    """The diagonal of L T T^T L^T for a root T, (K, q): (N,), sums of squares."""
    return np.square(problem.prior.spread(root)).sum(axis=1)
