"""The marginal likelihood of the measurements, by which a prior and the noise are found from the stack alone.

They are where it is largest (Mardia and Marshall 1984),

    g - H f0 ~ N(0, C),   C = H P0 H^T + Rv,

minus twice its logarithm being log det C + r^T C^-1 r. With P0 = L L^T and B = Rv^-1/2 H L, everything comes from the
Cholesky factor of I + B^T B, (N, N), and from sums of squares: r^T C^-1 r = |Rv^-1/2 (r - H L u)|^2 + |u|^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ..forms.form import Matrix, Vector
from ..prior import Prior, lag_distances, stationary_matrix

WHOLE = 1e-6  # of what a measurement sees: what may lie outside the tile that it counts for


@dataclass(frozen=True)
class Evidence:
    """The measurements and what is known of them.

    residual : (M,) r = g - H f0;  known_noise : (M,), of Rv the part that is not to be found
    prior : P0 where it is known; None where P0 = variance exp(-distance / length) is to be found
    noise_known : whether all of Rv is
    """

    matrix: sparse.csr_array
    residual: Vector
    known_noise: Vector
    shape: tuple[int, int]
    prior: Prior | None
    noise_known: bool

    def score(self, logarithms: Vector) -> tuple[float, Vector]:
        """Minus the logarithm of the likelihood, and its gradient, by the logarithms of what is to be found.

        logarithms : of variance and length (in pixels) unless P0 is known, then of the noise variance unless that is
        """
        if self.matrix.shape[0] < self.matrix.shape[1]:
            return self._by_measurements(logarithms)
        return self._by_pixels(logarithms)

    def _by_pixels(self, logarithms: Vector) -> tuple[float, Vector]:
        numbers, noise = self._numbers(logarithms)
        if self.prior is None:
            correlation, derivative = self._correlation(numbers[1])
            unit, variance = np.asarray(linalg.cholesky(correlation, lower=True, check_finite=False)), numbers[0]
        else:
            unit, variance, derivative = _dense(self.prior.root), 1.0, None
        half = variance**0.5 * unit
        inner: Matrix = half.T @ (self._weighted(1 / noise) @ half)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = np.asarray(linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)), True
        white: Vector = half.T @ (self.matrix.T @ (self.residual / noise))
        u: Vector = np.asarray(linalg.cho_solve(factor, white, check_finite=False))
        left: Vector = (self.residual - self.matrix @ (half @ u)) / noise
        determinant = float(np.log(noise).sum() + 2 * np.log(np.diagonal(factor[0])).sum())
        value = 0.5 * (determinant + float(noise @ left**2 + u @ u))
        shrunk = np.asarray(linalg.cho_solve(factor, np.eye(u.size), check_finite=False))
        slope = [] if derivative is None else _by_prior(unit, derivative, shrunk, u)
        if not self.noise_known:
            told = float(np.sum(self._weighted(noise**-2) * (half @ shrunk @ half.T)))
            slope.append(0.5 * numbers[-1] * (float(np.sum(1 / noise)) - told - float(left @ left)))
        return value, np.array(slope)

    def _by_measurements(self, logarithms: Vector) -> tuple[float, Vector]:
        """The same from C itself, the smaller matrix where measurements are fewer than pixels."""
        numbers, noise = self._numbers(logarithms)
        if self.prior is None:
            parts = [numbers[0] * self._observed(matrix) for matrix in self._correlation(numbers[1])]
        else:
            half = self.matrix @ _dense(self.prior.root)
            parts = [half @ half.T]
        matrix = parts[0] + np.diag(noise)
        factor = np.asarray(linalg.cholesky(matrix, lower=True, check_finite=False)), True
        pull: Vector = np.asarray(linalg.cho_solve(factor, self.residual, check_finite=False))
        value = float(np.log(np.diagonal(factor[0])).sum()) + 0.5 * float(self.residual @ pull)
        inverse = np.asarray(linalg.cho_solve(factor, np.eye(noise.size), check_finite=False))
        changes = [] if self.prior is not None else parts
        slope = [0.5 * (float(np.sum(inverse * change)) - float(pull @ change @ pull)) for change in changes]
        if not self.noise_known:
            slope.append(0.5 * numbers[-1] * (float(np.trace(inverse)) - float(pull @ pull)))
        return value, np.array(slope)

    def _numbers(self, logarithms: Vector) -> tuple[list[float], Vector]:
        numbers = [exp(value) for value in logarithms]
        return numbers, self.known_noise + (0.0 if self.noise_known else numbers[-1])

    def _observed(self, between: Matrix) -> Matrix:
        """H P H^T: (M, M)."""
        return np.asarray(self.matrix @ (self.matrix @ between).T)

    def blocks(self, side: int) -> list[Evidence]:
        """The same, cut into tiles of at most `side` x `side` pixels, each with the measurements that see it alone."""
        rows, columns = (np.array_split(np.arange(size), -(-size // side)) for size in self.shape)
        if len(rows) == len(columns) == 1:
            return [self]
        numbers = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        tiles = [(some_rows, some_columns) for some_rows in rows for some_columns in columns]
        return [self._tile(numbers[np.ix_(*tile)].ravel(), (tile[0].size, tile[1].size)) for tile in tiles]

    def _tile(self, pixels: NDArray[np.intp], shape: tuple[int, int]) -> Evidence:
        seen = abs(self.matrix)
        total, inside = seen.sum(axis=1), seen[:, pixels].sum(axis=1)
        whole = (total > 0) & (inside >= (1 - WHOLE) * total)
        prior = None if self.prior is None else self.prior.restrict(pixels)
        matrix = sparse.csr_array(self.matrix[whole][:, pixels])
        return Evidence(matrix, self.residual[whole], self.known_noise[whole], shape, prior, self.noise_known)

    def _correlation(self, length: float) -> tuple[Matrix, Matrix]:
        """P1 = exp(-distance / length) and its derivative by the logarithm of the length: (N, N) each."""
        lags = lag_distances(self.shape) / length
        return stationary_matrix(np.exp(-lags), self.shape), stationary_matrix(lags * np.exp(-lags), self.shape)

    def _weighted(self, weights: Vector) -> Matrix:
        return np.asarray((self.matrix.T @ sparse.csr_array(self.matrix.multiply(weights[:, None]))).toarray())


def _dense(root: Matrix) -> Matrix:
    return np.diag(root) if root.ndim == 1 else root


def _by_prior(unit: Matrix, derivative: Matrix, shrunk: Matrix, u: Vector) -> list[float]:
    # With G = (I + B^T B)^-1: H^T C^-1 H = L^-T (I - G) L^-1 and H^T C^-1 r = L^-T u, so no large numbers cancel.
    half_way = np.asarray(linalg.solve_triangular(unit, derivative, lower=True, check_finite=False))
    inside = np.asarray(linalg.solve_triangular(unit, half_way.T, lower=True, check_finite=False))
    by_variance = u.size - float(np.trace(shrunk)) - float(u @ u)
    by_length = float(np.trace(inside)) - float(np.sum(shrunk * inside)) - float(u @ inside @ u)
    return [0.5 * by_variance, 0.5 * by_length]
