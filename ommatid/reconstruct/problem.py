"""The linear inverse problem g = H f + v with prior and noise statistics (Wood et al. 2005, Eq. 1 to 3).

Products of H with its own transpose are dense where H is: a matrix with an entry in every tenth place or so, such as H
of lenses that diffract, is multiplied a hundred times faster as a dense one.

All forms solve one linear system. With f = f0 + L u and multipliers l,

    u - L^T H^T l = c,    H L u + Rv l = r.

With c = 0 and r = g - H f0, u gives the estimate. With r = 0 and c = L^T z, L u is the posterior covariance times z,
and -l is A^T z. The forms differ in the matrix they factorise, in cost, and in sensitivity to rounding.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import free_memory

from .prior import Prior

DENSE = 0.1  # share of entries from which dense products are faster
SMALL = 10_000  # entries of a matrix for which it makes no difference


def dense_or_sparse(matrix: sparse.csr_array) -> sparse.csr_array | FloatArray:
    """Return a matrix in the form whose products are faster: with its zeros where they are few, and fit into memory."""
    rows, columns = matrix.shape
    is_dense = SMALL < matrix.nnz > DENSE * rows * columns and 2 * 8 * rows * columns < free_memory()
    return matrix.toarray() if is_dense else matrix


def gram(matrix: sparse.csr_array | FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return A^T diag(w) A of a matrix A, (M, N), and (M,) weights, 1 where they are absent: (N, N)."""
    applied = matrix if isinstance(matrix, np.ndarray) else dense_or_sparse(matrix)
    if isinstance(applied, np.ndarray):
        scaled = applied if weights is None else applied * np.sqrt(weights)[:, None]
        return np.asarray(scaled.T @ scaled, dtype=np.float64)  # of one factor: half the operations
    weighted = applied if weights is None else sparse.csr_array(applied.multiply(weights[:, None]))
    return np.asarray((applied.T @ weighted).toarray(), dtype=np.float64)


@dataclass(frozen=True)
class Problem:
    """H as `matrix`, (M, N) CSR, the prior of f, and the diagonal of Rv as `noise_variance`, (M,), 0 allowed.

    With P0 = L L^T and Rv = S^2, S diagonal, every form solves for the coefficients u of f = f0 + L u, whose prior
    covariance is the identity, and where possible uses the whitened matrix B = S^-1 H L.
    Raises InputError if shapes do not match or values are not finite.
    """

    matrix: sparse.csr_array
    prior: Prior
    noise_variance: FloatArray

    def __post_init__(self) -> None:
        """Check shapes and values."""
        measurements, unknowns = self.matrix.shape
        if self.prior.mean.shape != (unknowns,) or self.prior.root.shape[0] != unknowns:
            raise InputError(f"expected a prior of {unknowns} pixels as H has, got one of {self.prior.mean.size}")
        if self.noise_variance.shape != (measurements,):
            raise InputError(f"expected {measurements} noise variances, got {self.noise_variance.size}")
        if not np.isfinite(self.noise_variance).all() or (self.noise_variance < 0).any():
            raise InputError("expected noise variances of 0 or more, got negative or infinite ones or NaN")
        for name, values in (("H", self.matrix.data), ("the prior", self.prior.root), ("f0", self.prior.mean)):
            if not np.isfinite(values).all():
                raise InputError(f"expected finite values in {name}, got infinite ones or NaN")

    def check(self, recorded: FloatArray, numbers: NDArray[np.intp] | slice = slice(None)) -> None:
        """Raise InputError unless there are M measurements, and those of `numbers` are finite."""
        if recorded.shape != (self.measurements,) or not np.isfinite(recorded[numbers]).all():
            raise InputError(
                f"expected {self.measurements} finite measurements, got others; leave dead pixels out first"
            )

    @property
    def measurements(self) -> int:
        """M, the number of measurements."""
        return int(self.matrix.shape[0])

    @property
    def unknowns(self) -> int:
        """N, the number of pixels of f."""
        return int(self.matrix.shape[1])

    @property
    def noisy(self) -> bool:
        """True if every measurement has noise, so that S is invertible."""
        return bool((self.noise_variance > 0).all())

    @cached_property
    def deviation(self) -> FloatArray:
        """Standard deviation of the noise, the diagonal of S: (M,)."""
        return np.sqrt(self.noise_variance)

    def forward(self, coefficients: FloatArray) -> FloatArray:
        """Apply H L: (K, q) to (M, q)."""
        return np.asarray(self._factor @ self.prior.apply_root(coefficients))

    def adjoint(self, measurements: FloatArray) -> FloatArray:
        """Apply L^T H^T: (M, q) to (K, q)."""
        return np.asarray(self.prior.apply_root_transposed(self._factor.T @ measurements))

    def pixel_shift(self, pixels: NDArray[np.intp]) -> FloatArray:
        """Return L^T e_i of each pixel i: (K, n)."""
        if not self.prior.independent:
            return self.prior.root[pixels].T
        shift = np.zeros((self.unknowns, pixels.size))
        shift[pixels, np.arange(pixels.size)] = self.prior.root[pixels]
        return shift

    def dense_matrix(self) -> FloatArray:
        """H L as a dense matrix: (M, K)."""
        if self.prior.independent:
            return np.asarray(self.matrix.multiply(self.prior.root[None, :]).toarray())
        return np.asarray(self._factor @ self.prior.root)

    @cached_property
    def _factor(self) -> sparse.csr_array | FloatArray:
        """H as products take it."""
        return dense_or_sparse(self.matrix)


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
