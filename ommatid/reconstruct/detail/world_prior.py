"""The prior of the world on its own grid, finer than f, and what f leaves open of it.

The world w has the covariance P, and f = A w averages it over F x F pixels. Given f, the best linear estimate of w is

    w0 + B (f - f0),   B = P A^T (A P A^T)^-1,   with covariance P - B A P.

P is stationary, so products with it are convolutions: a periodic one of twice the size holds every lag once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.processors import processors
from ommatid.scenes.tables.estimation import PriorTable

from ..prior import averaged_lags, covariance_lags, stationary_matrix

COLUMNS = 64  # of P A^T and P H^T that are computed at once


@dataclass(frozen=True)
class WorldPrior:
    """Covariance P of a world `detail` times finer than f, whose shape is `shape`; `lags` as of `covariance_lags`."""

    shape: tuple[int, int]
    detail: int
    lags: FloatArray

    @classmethod
    def of(cls, table: PriorTable, shape: tuple[int, int], pitch: float, detail: int) -> WorldPrior:
        """Return the prior of a [prior] table; shape, pitch : of f. Raises InputError for kind "fit"."""
        fine = shape[0] * detail, shape[1] * detail
        return cls(shape, detail, covariance_lags(table, fine, pitch / detail))

    @property
    def fine_shape(self) -> tuple[int, int]:
        """Rows and columns of the world."""
        return self.shape[0] * self.detail, self.shape[1] * self.detail

    @property
    def variance(self) -> float:
        """Variance of every pixel of the world."""
        return float(self.lags[0, 0])

    @cached_property
    def _spectrum(self) -> FloatArray:
        return np.asarray(fft.rfft2(self.lags).real, dtype=np.float64)

    def apply(self, images: FloatArray) -> FloatArray:
        """Return P X: (pixels of the world, q) to (pixels of the world, q)."""
        rows, columns = self.fine_shape
        product = np.empty(images.shape)
        for start in range(0, images.shape[1], COLUMNS):
            part = np.ascontiguousarray(images[:, start : start + COLUMNS].T).reshape(-1, rows, columns)
            # Rows of zeros are not transformed, nor rows transformed back that lie outside the world.
            waves = fft.rfft(part, n=self.lags.shape[1], workers=processors())
            waves = fft.fft(waves, n=self.lags.shape[0], axis=1, workers=processors(), overwrite_x=True)
            waves *= self._spectrum
            waves = fft.ifft(waves, axis=1, workers=processors(), overwrite_x=True)[:, :rows]
            spread = fft.irfft(waves, n=self.lags.shape[1], workers=processors())[:, :, :columns]
            product[:, start : start + COLUMNS] = spread.reshape(len(part), -1).T
        return product

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw a world less its mean: (pixels of the world,).

        What is negative in the spectrum of twice the size counts as 0, which adds to the finest detail where the world
        is only a few correlation lengths wide.
        """
        rows, columns = self.fine_shape
        waves = fft.rfft2(rng.normal(size=self.lags.shape)) * np.sqrt(np.maximum(self._spectrum, 0.0))
        return np.asarray(fft.irfft2(waves, s=self.lags.shape)[:rows, :columns], dtype=np.float64).ravel()

    @cached_property
    def averages(self) -> FloatArray:
        """P A^T, the covariances of the world's pixels with those of f: (pixels of the world, N)."""
        return self.apply(np.asarray(averaging(self.shape, self.detail).T.toarray(), dtype=np.float64))

    @cached_property
    def covariance(self) -> FloatArray:
        """A P A^T, the prior covariance of f: (N, N)."""
        return stationary_matrix(averaged_lags(self.lags, self.detail), self.shape)

    @cached_property
    def interpolation(self) -> FloatArray:
        """B, from deviations of f to those of the world: (pixels of the world, N)."""
        factor = linalg.cho_factor(self.covariance, lower=True, check_finite=False)
        return np.ascontiguousarray(linalg.cho_solve(factor, self.averages.T, check_finite=False).T)

    @cached_property
    def unresolved(self) -> FloatArray:
        """Variance of every pixel of the world given f, the diagonal of P - B A P: (pixels of the world,)."""
        explained = np.einsum("ij,ij->i", self.interpolation, self.averages)
        return np.maximum(self.variance - explained, 0.0)


def averaging(shape: tuple[int, int], detail: int) -> sparse.csr_array:
    """Return A, the averages over detail x detail pixels of the world: (N, pixels of the world)."""
    rows, columns = (sparse.kron(sparse.eye_array(size), np.full((1, detail), 1 / detail)) for size in shape)
    return sparse.csr_array(sparse.kron(rows, columns, format="csr"))


def repetition(shape: tuple[int, int], detail: int) -> sparse.csr_array:
    """Return the world made of f's pixels, each repeated detail x detail times: (pixels of the world, N)."""
    return sparse.csr_array(averaging(shape, detail).T * float(detail**2))
