"""Prior of an image: its mean f0 and covariance P0 = L L^T.

Only the root L is used, so P0 may be singular (known pixels) or tiny; no inverse of it is needed.

Correlated pixels have reflecting edges: the image is continued by its mirror image about a line half a pixel beyond its
outermost pixels. Then P0 = C^T diag(s) C with the orthonormal DCT-II C along both axes and a spectrum s > 0: the cosine
waves are independent. Dense problems, frames and worlds finer than f have the same s, whose mean is the variance of a
pixel, averaged over the image:

    exponential   s_k = c_k^T E c_k,   E = variance exp(-distance / length),   c_k the k-th wave
    power         s_k proportional to |w_k|^-a,   w_k = pi (row / rows, column / columns);   w_0 as the lowest other
    fit           s_k = sum of c (1 / l^2 + |w|^2)^(-a/2) over terms (c, a, l), and over w_k and its nearest aliases w

The first gives each wave the variance that it has where E is the covariance. That is the spectral density of E, the sum
of (1 / length^2 + |w + 2 pi m|^2)^(-3/2) over all aliases m times a constant, averaged over the width of the wave in
frequency. So s is positive, and of all reflecting priors this one is the closest to E by relative entropy.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import fft, linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.tables import estimation

EPS = float(np.finfo(np.float64).eps)
ROUNDING = 16 * EPS  # of an entry of L L^T, by those of the waves
DEFAULT_EXPONENT = 2.0  # of the power-law spectrum
NEEDS_FIT = "prior.kind 'fit' takes a recorded stack; set another kind to predict without one"


class SpectralTerm(NamedTuple):
    """A term c (1 / l^2 + |w|^2)^(-a/2) of a spectral density on the target; w in radians per millimetre.

    density : c;  exponent : a;  length : l in millimetres
    """

    density: float
    exponent: float
    length: float


class FittedPrior(estimation.PriorTable):
    """A prior by its spectral density: the sum of `terms`; `variance` is that of a pixel of a window."""

    terms: tuple[SpectralTerm, ...]

    @classmethod
    def of(cls, table: estimation.PriorTable, terms: tuple[SpectralTerm, ...], variance: float = 1.0) -> FittedPrior:
        """Return the prior with the mean and the level of a [prior] table."""
        return cls(kind="fit", mean=table.mean, level=table.level, variance=variance, terms=terms)


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

    def variance_of(self, covariance: FloatArray) -> FloatArray:
        """Return the variance of every pixel, (N,), from the covariance of u, (K, K)."""
        if self.independent:
            return self.variance * np.diagonal(covariance)
        return np.einsum("ij,ij->i", self.root @ covariance, self.root)

    def scaled(self, ratio: float) -> Prior:
        """Return the prior with `ratio` times the covariance."""
        return self if ratio == 1 else Prior(self.mean, ratio**0.5 * self.root, self.rounding)


def independent(mean: float, variance: float, unknowns: int) -> Prior:
    """Return the prior of the paper: independent pixels, all with the same mean and variance."""
    return Prior(np.full(unknowns, mean), np.full(unknowns, variance**0.5))


def exponential(mean: float, variance: float, shape: tuple[int, int], length: float) -> Prior:
    """Return the isotropic prior nearest to the covariance variance exp(-distance / length); `length` in pixels."""
    return _reflected(mean, variance * exponential_spectrum(shape, length))


def prior_of(table: estimation.PriorTable, shape: tuple[int, int], pitch: float, detail: int = 1) -> Prior:
    """Return the prior of a scene's [prior] table for an image of `shape` with a pixel pitch of `pitch` millimetres.

    detail : a correlated prior is that of a world so many times finer, of which the image is the average
    Raises InputError for kind "fit", which needs a stack.
    """
    spectrum = spectrum_of(table, shape, pitch, detail)
    if isinstance(spectrum, np.ndarray):
        return _reflected(table.mean, spectrum)
    return independent(table.mean, spectrum, shape[0] * shape[1])


def spectrum_of(
    table: estimation.PriorTable,
    shape: tuple[int, int],
    pitch: float,
    detail: int = 1,
    whole: tuple[int, int] | None = None,
) -> float | FloatArray:
    """Return the variance of independent pixels, else s, the eigenvalues of P0 under the DCT-II: (rows, columns).

    Arguments as of `prior_of`;  whole : of the image that has the table's variance, if `shape` is a part of it
    Raises InputError for kind "fit", which needs a stack.
    """
    if table.kind == "independent":
        return table.variance
    fine = shape[0] * detail, shape[1] * detail
    if isinstance(table, FittedPrior):
        densities = [natural_spectrum(fine, pitch / detail, term) for term in table.terms]
        return averaged_spectrum(np.sum(densities, axis=0), detail)
    if table.kind == "exponential" and table.correlation_length is not None:
        spectrum = exponential_spectrum(fine, table.correlation_length * detail / pitch)
    elif table.kind == "power":
        exponent = DEFAULT_EXPONENT if table.exponent is None else table.exponent
        rows, columns = shape if whole is None else whole
        every = _power_spectrum((rows * detail, columns * detail), exponent)
        spectrum = _power_spectrum(fine, exponent) / every.mean()
    else:
        raise InputError(NEEDS_FIT)
    return table.variance * averaged_spectrum(spectrum, detail)


def exponential_spectrum(shape: tuple[int, int], length: float) -> FloatArray:
    """Return s, (rows, columns), of variance 1; `length` in pixels."""
    # The constant 1 is a multiple of the first wave; without it long correlations leave no small differences.
    spectrum = wave_variances(np.expm1(-lag_distances(shape) / length))
    spectrum[0, 0] += spectrum.size
    return spectrum


def lag_distances(shape: tuple[int, int]) -> FloatArray:
    """Return the distance in pixels of every lag from 0: (rows, columns)."""
    return np.hypot(np.arange(shape[0])[:, None], np.arange(shape[1])[None, :])


def wave_variances(lags: FloatArray) -> FloatArray:
    """Return c_k^T E c_k of every cosine wave, (rows, columns), of a stationary covariance E.

    lags : (rows, columns) of E, an even function of the lag along either axis
    """
    return _along_columns(_along_columns(lags).T).T


def _along_columns(lags: FloatArray) -> FloatArray:
    """Return sums over all pairs of places of c_k(i) c_k(j) E(i - j) along the last axis.

    The waves at a lag d share (n - d) cos(pi k d / n) / n, and less by sin(pi k d / n) / (n sin(pi k / n)) for k > 0.
    """
    size = lags.shape[-1]
    tapered = np.zeros((lags.shape[0], size + 1))
    tapered[:, :size] = lags * (size - np.arange(size)) / size
    sums: FloatArray = np.asarray(fft.dct(tapered, 1), dtype=np.float64)[:, :size]
    if size > 1:
        sines = np.sin(np.linspace(0, np.pi, size, endpoint=False)[1:])
        sums[:, 1:] -= np.asarray(fft.dst(lags[:, 1:], 1), dtype=np.float64) / (size * sines)
    return sums


def _power_spectrum(shape: tuple[int, int], exponent: float) -> FloatArray:
    """Return s, (rows, columns), of the density 1/frequency^a in every image."""
    vertical, horizontal = (np.arange(size) / size for size in shape)
    frequency = np.hypot(vertical[:, None], horizontal[None, :])
    frequency[0, 0] = 1 / max(shape)
    return frequency**-exponent


def natural_spectrum(shape: tuple[int, int], pitch: float, term: SpectralTerm) -> FloatArray:
    """Return s, (rows, columns), of pixels that are samples of a term of a spectral density, by its nearest aliases.

    pitch : of the pixels, in millimetres
    """
    total = np.zeros(shape)
    for beyond in product((0, 2), repeat=2):
        vertical, horizontal = (
            np.square(np.pi * (np.arange(size) / size - alias) / pitch)
            for size, alias in zip(shape, beyond, strict=True)
        )
        total += (vertical[:, None] + horizontal[None, :] + term.length**-2) ** (-term.exponent / 2)
    return term.density / pitch**2 * total


def averaged_spectrum(spectrum: FloatArray, detail: int) -> FloatArray:
    """Return the spectrum of averages over detail x detail pixels, (rows, columns): A P A^T for box averages A.

    spectrum : (detail rows, detail columns) of the pixels that are averaged
    """
    if detail == 1:
        return spectrum
    vertical, horizontal = (_bands(size // detail, detail) for size in spectrum.shape)
    return np.asarray(vertical @ (horizontal @ spectrum.T).T)


def _bands(size: int, detail: int) -> sparse.csr_array:
    """Return the power of each fine wave in each wave of averages over `detail` pixels: (size, detail size)."""
    fine = np.arange(1, size * detail)
    angle = np.pi * fine / (2 * size)
    power = np.square(np.sin(angle) / (detail * np.sin(angle / detail))) / detail
    alias = np.minimum(fine % (2 * size), -fine % (2 * size))
    power[alias == 0] *= 2  # the constant wave is normalised otherwise
    power, alias = np.append(power, 1 / detail), np.append(alias, 0)
    seen = alias < size
    places = alias[seen], np.append(fine, 0)[seen]
    return sparse.csr_array((power[seen], places), shape=(size, size * detail))


def coloured(spectrum: float | FloatArray, white: FloatArray) -> FloatArray:
    """Return images of the covariance P0, less their mean, from white noise: (..., rows, columns)."""
    if isinstance(spectrum, float):
        return spectrum**0.5 * white
    return np.asarray(fft.idctn(np.sqrt(spectrum) * white, 2, axes=(-2, -1), norm="ortho"))


def cosine_waves(size: int) -> FloatArray:
    """Return the waves of the orthonormal DCT-II as columns: (size, size)."""
    return np.asarray(fft.idct(np.eye(size), 2, axis=0, norm="ortho"), dtype=np.float64)


def reflecting_root(spectrum: FloatArray) -> FloatArray:
    """Return L = C^T diag(s)^1/2, (N, N), a column for each wave."""
    vertical, horizontal = (cosine_waves(size) for size in spectrum.shape)
    root = vertical[:, None, :, None] * horizontal[None, :, None, :]
    root *= np.sqrt(spectrum)
    return root.reshape(spectrum.size, spectrum.size)


def covariance_root(covariance: FloatArray) -> FloatArray:
    """Return L with L L^T = P0, (N, N): Cholesky, or the symmetric root if P0 is singular in float64."""
    try:
        return np.asarray(linalg.cholesky(covariance, lower=True, check_finite=False))
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(covariance, check_finite=False)
        return vectors * np.sqrt(np.maximum(values, 0.0))


def _reflected(mean: float, spectrum: FloatArray) -> Prior:
    return Prior(np.full(spectrum.size, mean), reflecting_root(spectrum), ROUNDING)


def _scale_rows(root: FloatArray, values: FloatArray) -> FloatArray:
    return root * values if values.ndim == 1 else root[:, None] * values
