"""Prior of an image: its mean f0 and covariance P0 = L L^T.

Only the root L is used, so P0 may be singular (known pixels) or tiny; no inverse of it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.tables import estimation

LEAST_POWER = 1e-12  # relative to the largest; periodic continuation of a covariance may have negative eigenvalues
DEFAULT_EXPONENT = 2.0  # of the power-law spectrum
NEEDS_FIT = "prior.kind 'fit' takes a recorded stack; set another kind to predict without one"


@dataclass(frozen=True)
class Prior:
    """(N,) `mean`, and L as `root`: (N,) standard deviations of independent pixels, or (N, K) for correlated ones."""

    mean: FloatArray
    root: FloatArray

    @property
    def independent(self) -> bool:
        """True if P0 is diagonal."""
        return self.root.ndim == 1

    @property
    def variance(self) -> FloatArray:
        """Prior variance of every pixel, the diagonal of P0: (N,)."""
        return np.square(self.root) if self.independent else np.square(self.root).sum(axis=1)

    @property
    def dimension(self) -> int:
        """K, the number of columns of L and of coefficients u in f = f0 + L u."""
        return int(self.root.shape[-1])

    def apply_root(self, coefficients: FloatArray) -> FloatArray:
        """Return L u: (K,) to (N,), or (K, q) to (N, q)."""
        return _scale_rows(self.root, coefficients) if self.independent else self.root @ coefficients

    def apply_root_transposed(self, image: FloatArray) -> FloatArray:
        """Return L^T f: (N,) to (K,), or (N, q) to (K, q)."""
        return _scale_rows(self.root, image) if self.independent else self.root.T @ image

    def restrict(self, pixels: NDArray[np.intp]) -> Prior:
        """Return the marginal prior of these pixels."""
        rows = self.root[pixels]
        return Prior(self.mean[pixels], rows if self.independent else _covariance_root(rows @ rows.T))


def independent(mean: float, variance: float, unknowns: int) -> Prior:
    """Return the prior of the paper: independent pixels, all with the same mean and variance."""
    return Prior(np.full(unknowns, mean), np.full(unknowns, variance**0.5))


def exponential(mean: float, variance: float, shape: tuple[int, int], length: float) -> Prior:
    """Return the isotropic prior P0 = variance exp(-distance / length); `length` in pixels."""
    return _stationary(mean, variance, shape, np.exp(-lag_distances(shape) / length))


def prior_of(table: estimation.PriorTable, shape: tuple[int, int], pitch: float) -> Prior:
    """Return the prior of a scene's [prior] table for an image of `shape` with a pixel pitch of `pitch` millimetres.

    Raises InputError for kind "fit", which needs a stack.
    """
    if table.kind == "independent":
        return independent(table.mean, table.variance, shape[0] * shape[1])
    if table.kind == "exponential" and table.correlation_length is not None:
        return exponential(table.mean, table.variance, shape, table.correlation_length / pitch)
    if table.kind == "power":
        return _stationary(table.mean, table.variance, shape, _power_correlation(shape, table.exponent))
    raise InputError(NEEDS_FIT)


def spectrum_of(table: estimation.PriorTable, shape: tuple[int, int], pitch: float) -> float | FloatArray:
    """Return the diagonal form of P0: the variance of independent pixels, else its spectrum under the DCT-II.

    The DCT reflects the image at its edges. Inside, this prior equals the stationary one of `prior_of`; within a
    correlation length of an edge the variance is larger. Raises InputError for kind "fit", which needs a stack.
    """
    if table.kind == "independent":
        return table.variance
    if table.kind == "exponential" and table.correlation_length is not None:
        correlation = np.exp(-lag_distances(shape) * pitch / table.correlation_length)
    elif table.kind == "power":
        correlation = _power_correlation(shape, table.exponent)
    else:
        raise InputError(NEEDS_FIT)
    spectrum = np.fft.fft2(correlation).real[: shape[0], : shape[1]]
    return table.variance * np.maximum(spectrum, LEAST_POWER * float(spectrum.max()))


def lag_distances(shape: tuple[int, int]) -> FloatArray:
    """Return the distance in pixels of every lag, (2 rows, 2 columns); index -1 is a lag of -1 (periodic)."""
    row_lags, column_lags = (np.minimum(np.arange(2 * size), 2 * size - np.arange(2 * size)) for size in shape)
    return np.hypot(row_lags[:, None], column_lags[None, :])


def stationary_matrix(lags: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the (N, N) matrix over pairs of pixels of a function of the lag, (2 rows, 2 columns)."""
    rows, columns = shape
    row_lags = np.subtract.outer(np.arange(rows), np.arange(rows)) % (2 * rows)
    column_lags = np.subtract.outer(np.arange(columns), np.arange(columns)) % (2 * columns)
    table = lags[row_lags[:, None, :, None], column_lags[None, :, None, :]]
    return np.ascontiguousarray(table.reshape(rows * columns, rows * columns))


def _covariance_root(covariance: FloatArray) -> FloatArray:
    """Return L with L L^T = P0, (N, N): Cholesky, or the symmetric root if P0 is singular in float64."""
    try:
        return np.asarray(linalg.cholesky(covariance, lower=True, check_finite=False))
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(covariance, check_finite=False)
        return vectors * np.sqrt(np.maximum(values, 0.0))


def _stationary(mean: float, variance: float, shape: tuple[int, int], correlation: FloatArray) -> Prior:
    root = _covariance_root(stationary_matrix(correlation, shape))
    return Prior(np.full(shape[0] * shape[1], mean), variance**0.5 * root)


def _power_correlation(shape: tuple[int, int], exponent: float | None) -> FloatArray:
    """Return the correlation at every lag, (2 rows, 2 columns), of a power-law spectrum; twice the size avoids wrap."""
    row_frequency, column_frequency = np.fft.fftfreq(2 * shape[0]), np.fft.fftfreq(2 * shape[1])
    frequency = np.hypot(row_frequency[:, None], column_frequency[None, :])
    frequency[0, 0] = frequency[frequency > 0].min()  # the mean gets the power of the lowest frequency
    lags = np.fft.ifft2(frequency ** -(DEFAULT_EXPONENT if exponent is None else exponent)).real
    return lags / lags[0, 0]


def _scale_rows(root: FloatArray, values: FloatArray) -> FloatArray:
    return root * values if values.ndim == 1 else root[:, None] * values
