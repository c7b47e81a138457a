"""The evidence: the marginal likelihood of the measurements, which a fit of prior and noise maximises.

With (Mardia and Marshall 1984)

    g - H f0 ~ N(0, C),   C = H P0 H^T + Rv,

minus twice its logarithm is log det C + r^T C^-1 r, without constants. With P0 = L L^T and B = Rv^-1/2 H L, everything
follows from the Cholesky factor of I + B^T B, (N, N), and from sums of squares:
r^T C^-1 r = |Rv^-1/2 (r - H L u)|^2 + |u|^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray

from ..prior import Prior, exponential_spectrum, lag_distances, reflecting_root, wave_variances
from ..problem import gram

OUTSIDE = 1e-6  # share of a measurement's footprint that may lie outside its tile


@dataclass(frozen=True)
class Evidence:
    """Measurements, and the known parts of their covariance.

    residual : (M,) r = g - H f0;  known_noise : (M,), the part of Rv that is not to be fitted
    prior : P0 where it is known; None where variance and length of an exponential prior are to be fitted
    noise_known : True if `known_noise` is all of Rv
    """

    matrix: sparse.csr_array
    residual: FloatArray
    known_noise: FloatArray
    shape: tuple[int, int]
    prior: Prior | None
    noise_known: bool

    def score(self, logarithms: FloatArray) -> tuple[float, FloatArray]:
        """Return minus the log evidence and its gradient with respect to the logarithms of the parameters.

        logarithms : of variance and length (pixels) unless P0 is known, then of the noise variance unless that is known
        """
        if self.matrix.shape[0] < self.matrix.shape[1]:
            return self._score_by_measurements(logarithms)
        return self._score_by_pixels(logarithms)

    def _score_by_pixels(self, logarithms: FloatArray) -> tuple[float, FloatArray]:
        parameters, noise = self._parameters(logarithms)
        root = self._root(parameters)
        inner: FloatArray = root.T @ (self._normal_matrix(1 / noise) @ root)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = np.asarray(linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)), True
        right_side: FloatArray = root.T @ (self.matrix.T @ (self.residual / noise))
        u: FloatArray = np.asarray(linalg.cho_solve(factor, right_side, check_finite=False))
        multipliers: FloatArray = (self.residual - self.matrix @ (root @ u)) / noise
        determinant = float(np.log(noise).sum() + 2 * np.log(np.diagonal(factor[0])).sum())
        value = 0.5 * (determinant + float(noise @ multipliers**2 + u @ u))
        inverse = np.asarray(linalg.cho_solve(factor, np.eye(u.size), check_finite=False))
        # H^T C^-1 H = L^-T (I - G) L^-1 and H^T C^-1 r = L^-T u with G = `inverse`, so no large numbers cancel.
        left = 1 - np.diagonal(inverse) - np.square(u)
        slope = [0.5 * float(change @ left) for change in self._changes(parameters)]
        if not self.noise_known:
            trace = float(np.sum(self._normal_matrix(noise**-2) * (root @ inverse @ root.T)))
            squares = float(multipliers @ multipliers)
            slope.append(0.5 * parameters[-1] * (float(np.sum(1 / noise)) - trace - squares))
        return value, np.array(slope)

    def _score_by_measurements(self, logarithms: FloatArray) -> tuple[float, FloatArray]:
        """Return the same from C itself, the smaller matrix where measurements are fewer than pixels."""
        parameters, noise = self._parameters(logarithms)
        root = self.matrix @ self._root(parameters)
        covariance = root @ root.T + np.diag(noise)
        factor = np.asarray(linalg.cholesky(covariance, lower=True, check_finite=False)), True
        multipliers: FloatArray = np.asarray(linalg.cho_solve(factor, self.residual, check_finite=False))
        value = float(np.log(np.diagonal(factor[0])).sum()) + 0.5 * float(self.residual @ multipliers)
        inverse = np.asarray(linalg.cho_solve(factor, np.eye(noise.size), check_finite=False))
        traces = np.einsum("ij,ij->j", root, inverse @ root) - np.square(root.T @ multipliers)
        slope = [0.5 * float(change @ traces) for change in self._changes(parameters)]
        if not self.noise_known:
            slope.append(0.5 * parameters[-1] * (float(np.trace(inverse)) - float(multipliers @ multipliers)))
        return value, np.array(slope)

    def _parameters(self, logarithms: FloatArray) -> tuple[list[float], FloatArray]:
        """Return the parameters and the whole noise, (M,)."""
        parameters = [exp(value) for value in logarithms]
        return parameters, self.known_noise + (0.0 if self.noise_known else parameters[-1])

    def _root(self, parameters: list[float]) -> FloatArray:
        """Return L: (N, N)."""
        if self.prior is not None:
            return np.diag(self.prior.root) if self.prior.independent else self.prior.root
        return reflecting_root(parameters[0] * exponential_spectrum(self.shape, parameters[1]))

    def _changes(self, parameters: list[float]) -> list[FloatArray]:
        """Return derivatives of the logarithm of each wave's variance, (N,), by those of variance and length."""
        if self.prior is not None:
            return []
        lags = lag_distances(self.shape) / parameters[1]
        change = wave_variances(lags * np.exp(-lags)) / exponential_spectrum(self.shape, parameters[1])
        return [np.ones(change.size), change.ravel()]

    def blocks(self, side: int) -> list[Evidence]:
        """Cut into tiles of at most `side` x `side` pixels, each with the measurements that see it alone."""
        rows, columns = (np.array_split(np.arange(size), -(-size // side)) for size in self.shape)
        if len(rows) == len(columns) == 1:
            return [self]
        indices = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        return [
            self._tile(indices[np.ix_(tile_rows, tile_columns)].ravel(), (tile_rows.size, tile_columns.size))
            for tile_rows in rows
            for tile_columns in columns
        ]

    def _tile(self, pixels: NDArray[np.intp], shape: tuple[int, int]) -> Evidence:
        weights = abs(self.matrix)
        total, inside = weights.sum(axis=1), weights[:, pixels].sum(axis=1)
        whole = (total > 0) & (inside >= (1 - OUTSIDE) * total)
        prior = None if self.prior is None else self.prior.restrict(pixels)
        matrix = sparse.csr_array(self.matrix[whole][:, pixels])
        return Evidence(matrix, self.residual[whole], self.known_noise[whole], shape, prior, self.noise_known)

    def _normal_matrix(self, weights: FloatArray) -> FloatArray:
        """Return H^T diag(weights) H: (N, N)."""
        return gram(self.matrix, weights)
