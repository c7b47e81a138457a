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

EPS = float(np.finfo(np.float64).eps)
ROUNDING = 4 * EPS  # of an entry of P0, and of its Cholesky factor
LEAST_POWER = 1e-12  # relative to the largest; periodic continuation of a covariance may have negative eigenvalues
DEFAULT_EXPONENT = 2.0  # of the power-law spectrum
NEEDS_FIT = "prior.kind 'fit' takes a recorded stack; set another kind to predict without one"


@dataclass(frozen=True)
class Prior:
    """(N,) `mean`, and L as `root`: (N,) standard deviations of independent pixels, or (N, K) for correlated ones.

    rounding : error of L L^T as an approximation of P0, relative to the standard deviations of both pixels
    """

    mean: FloatArray
    root: FloatArray
    rounding: float = 0.0

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

    def scaled(self, ratio: float) -> Prior:
        """Return the prior with `ratio` times the covariance."""
        return self if ratio == 1 else Prior(self.mean, ratio**0.5 * self.root, self.rounding)

    def restrict(self, pixels: NDArray[np.intp]) -> Prior:
        """Return the marginal prior of these pixels."""
        rows = self.root[pixels]
        if self.independent:
            return Prior(self.mean[pixels], rows)
        return Prior(self.mean[pixels], covariance_root(rows @ rows.T), self.rounding)


def independent(mean: float, variance: float, unknowns: int) -> Prior:
    """Return the prior of the paper: independent pixels, all with the same mean and variance."""
    return Prior(np.full(unknowns, mean), np.full(unknowns, variance**0.5))


def exponential(mean: float, variance: float, shape: tuple[int, int], length: float) -> Prior:
    """Return the isotropic prior P0 = variance exp(-distance / length); `length` in pixels."""
    return _stationary(mean, shape, variance * np.exp(-lag_distances(shape) / length))


def prior_of(table: estimation.PriorTable, shape: tuple[int, int], pitch: float, detail: int = 1) -> Prior:
    """Return the prior of a scene's [prior] table for an image of `shape` with a pixel pitch of `pitch` millimetres.

    detail : a correlated prior is that of a world so many times finer, of which the image is the average
    Raises InputError for kind "fit", which needs a stack.
    """
    if table.kind == "independent":
        return independent(table.mean, table.variance, shape[0] * shape[1])
    return _stationary(table.mean, shape, _image_lags(table, shape, pitch, detail))


def spectrum_of(
    table: estimation.PriorTable, shape: tuple[int, int], pitch: float, detail: int = 1
) -> float | FloatArray:
    """Return the diagonal form of P0: the variance of independent pixels, else its spectrum under the DCT-II.

    Arguments as of `prior_of`. The DCT reflects the image at its edges. Inside, this prior equals the stationary one
    of `prior_of`; within a correlation length of an edge the variance is larger. Raises InputError for kind "fit",
    which needs a stack.
    """
    if table.kind == "independent":
        return table.variance
    lags = _image_lags(table, shape, pitch, detail)
    spectrum: FloatArray = np.fft.fft2(lags).real[: shape[0], : shape[1]]
    return np.maximum(spectrum, LEAST_POWER * float(spectrum.max()))


def covariance_lags(table: estimation.PriorTable, shape: tuple[int, int], pitch: float) -> FloatArray:
    """Return the covariance at every lag, (2 rows, 2 columns), of a correlated prior; index -1 is a lag of -1.

    Raises InputError for kind "fit", which needs a stack, ValueError for independent pixels.
    """
    if table.kind == "exponential" and table.correlation_length is not None:
        return table.variance * np.exp(-lag_distances(shape) * pitch / table.correlation_length)
    if table.kind == "power":
        return table.variance * _power_correlation(shape, table.exponent)
    if table.kind == "independent":
        raise ValueError("expected a correlated prior, got one of independent pixels")
    raise InputError(NEEDS_FIT)


def averaged_lags(lags: FloatArray, detail: int) -> FloatArray:
    """Return the covariance at every lag of averages over detail x detail pixels: A P A^T for box averages A.

    lags : (2 detail rows, 2 detail columns) of the pixels that are averaged; the result is (2 rows, 2 columns)
    """
    if detail == 1:
        return lags
    waves = np.fft.rfft2(lags)
    for axis, size in enumerate(lags.shape):
        frequency = np.fft.fftfreq(size) if axis == 0 else np.fft.rfftfreq(size)
        box = np.exp(-2j * np.pi * np.outer(frequency, np.arange(detail))).mean(axis=1)
        waves *= np.expand_dims(np.square(np.abs(box)), 1 - axis)
    return np.ascontiguousarray(np.fft.irfft2(waves, s=lags.shape)[::detail, ::detail])


def _image_lags(table: estimation.PriorTable, shape: tuple[int, int], pitch: float, detail: int) -> FloatArray:
    fine = shape[0] * detail, shape[1] * detail
    return averaged_lags(covariance_lags(table, fine, pitch / detail), detail)


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


def covariance_root(covariance: FloatArray) -> FloatArray:
    """Return L with L L^T = P0, (N, N): Cholesky, or the symmetric root if P0 is singular in float64."""
    try:
        return np.asarray(linalg.cholesky(covariance, lower=True, check_finite=False))
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(covariance, check_finite=False)
        return vectors * np.sqrt(np.maximum(values, 0.0))


def _stationary(mean: float, shape: tuple[int, int], lags: FloatArray) -> Prior:
    covariance = stationary_matrix(lags, shape)
    root = covariance_root(covariance)
    rounding = ROUNDING if np.array_equal(root, np.tril(root)) else _defect(root, covariance)
    return Prior(np.full(shape[0] * shape[1], mean), root, rounding)


def _defect(root: FloatArray, covariance: FloatArray) -> float:
    """Return the largest error of L L^T by rounding, relative to the standard deviations, and that of P0 itself."""
    deviation = np.sqrt(np.diagonal(covariance))
    error = np.abs(root @ root.T - covariance) / (deviation[:, None] * deviation)
    return ROUNDING + min(float(error.max(initial=0.0)), deviation.size * EPS)


def _power_correlation(shape: tuple[int, int], exponent: float | None) -> FloatArray:
    """Return the correlation at every lag, (2 rows, 2 columns), of a power-law spectrum; twice the size avoids wrap."""
    row_frequency, column_frequency = np.fft.fftfreq(2 * shape[0]), np.fft.fftfreq(2 * shape[1])
    frequency = np.hypot(row_frequency[:, None], column_frequency[None, :])
    frequency[0, 0] = frequency[frequency > 0].min()  # the mean gets the power of the lowest frequency
    lags = np.fft.ifft2(frequency ** -(DEFAULT_EXPONENT if exponent is None else exponent)).real
    return lags / lags[0, 0]


def _scale_rows(root: FloatArray, values: FloatArray) -> FloatArray:
    return root * values if values.ndim == 1 else root[:, None] * values
