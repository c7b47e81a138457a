"""What is known of an image before any light is recorded: its mean f0 and covariance P0 = L L^T.

Everything downstream works with the root L alone, so that P0 may be singular (known pixels) or tiny without an inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ommatid.runtime.errors import InputError
from ommatid.scenes.tables import estimation

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

LEAST_POWER = 1e-12  # of the largest, of a frequency: what a torus makes of a covariance may be a little below zero
NOT_YET_FOUND = "prior.kind 'fit' takes a recorded stack; set another kind to predict without one"


@dataclass(frozen=True)
class Prior:
    """(N,) `mean`, and L as `root`: (N,) deviations of independent pixels, or (N, K) where pixels go together."""

    mean: Vector
    root: Vector | Matrix

    @property
    def independent(self) -> bool:
        """Whether P0 is diagonal."""
        return self.root.ndim == 1

    @property
    def variance(self) -> Vector:
        """The diagonal of P0: (N,)."""
        return np.square(self.root) if self.independent else np.square(self.root).sum(axis=1)

    @property
    def freedoms(self) -> int:
        """K, the columns of L: how many independent numbers make an image."""
        return int(self.root.shape[-1])

    def spread(self, freedoms: Matrix) -> Matrix:
        """L u: (K,) to (N,), or (K, q) to (N, q)."""
        return _diagonal(self.root, freedoms) if self.independent else self.root @ freedoms

    def gather(self, image: Matrix) -> Matrix:
        """L^T f: (N,) to (K,), or (N, q) to (K, q)."""
        return _diagonal(self.root, image) if self.independent else self.root.T @ image

    def restrict(self, pixels: NDArray[np.intp]) -> Prior:
        """Of some pixels alone."""
        some = self.root[pixels]
        return Prior(self.mean[pixels], some if self.independent else root_of(some @ some.T))


def independent(mean: float, variance: float, unknowns: int) -> Prior:
    """The paper's prior: every pixel with the same mean and variance, independent of its neighbours."""
    return Prior(np.full(unknowns, mean), np.full(unknowns, variance**0.5))


def prior_of(described: estimation.PriorTable, shape: tuple[int, int], pitch: float) -> Prior:
    """The prior that a scene describes, for an image of `shape` whose pixels are `pitch` millimetres apart.

    Raises InputError for kind "fit", which takes a stack to find.
    """
    unknowns = shape[0] * shape[1]
    if described.kind == "independent":
        return independent(described.mean, described.variance, unknowns)
    if described.kind == "exponential" and described.correlation_length is not None:
        return exponential(described.mean, described.variance, shape, described.correlation_length / pitch)
    if described.kind == "power":
        exponent = 2.0 if described.exponent is None else described.exponent
        return _stationary(described.mean, described.variance, shape, _power_lags(shape, exponent))
    raise InputError(NOT_YET_FOUND)


def spectrum_of(described: estimation.PriorTable, shape: tuple[int, int], pitch: float) -> float | Matrix:
    """P0 as it is diagonal: the variance of independent pixels, else its spectrum under the cosine transform (DCT-II).

    Such a prior is the stationary one reflected at the edges of the image: inside the two are the same, and within a
    correlation length of an edge pixels vary more. Raises InputError for kind "fit", which takes a stack to find.
    """
    if described.kind == "independent":
        return described.variance
    if described.kind == "exponential" and described.correlation_length is not None:
        lags = np.exp(-lag_distances(shape) * pitch / described.correlation_length)
    elif described.kind == "power":
        lags = _power_lags(shape, 2.0 if described.exponent is None else described.exponent)
    else:
        raise InputError(NOT_YET_FOUND)
    waves = np.fft.fft2(lags).real[: shape[0], : shape[1]]
    return described.variance * np.maximum(waves, LEAST_POWER * float(waves.max()))


def exponential(mean: float, variance: float, shape: tuple[int, int], length: float) -> Prior:
    """P0 = variance exp(-distance / length), isotropic; `length` in pixels."""
    return _stationary(mean, variance, shape, np.exp(-lag_distances(shape) / length))


def lag_distances(shape: tuple[int, int]) -> Matrix:
    """Distance in pixels for every lag, (2 rows, 2 columns); lags wrap round, so that index -1 is a lag of -1."""
    down, across = (np.minimum(np.arange(2 * size), 2 * size - np.arange(2 * size)) for size in shape)
    return np.hypot(down[:, None], across[None, :])


def between_pixels(lags: Matrix, shape: tuple[int, int]) -> Matrix:
    """A function of the lag, (2 rows, 2 columns), as an (N, N) matrix over pairs of pixels, row by row."""
    rows, columns = shape
    down = np.subtract.outer(np.arange(rows), np.arange(rows)) % (2 * rows)
    across = np.subtract.outer(np.arange(columns), np.arange(columns)) % (2 * columns)
    table = lags[down[:, None, :, None], across[None, :, None, :]]
    return np.ascontiguousarray(table.reshape(rows * columns, rows * columns))


def root_of(covariance: Matrix) -> Matrix:
    """L with L L^T = P0, (N, N): Cholesky, or the symmetric root where P0 is singular in float64."""
    try:
        return np.asarray(linalg.cholesky(covariance, lower=True, check_finite=False))
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(covariance, check_finite=False)
        return vectors * np.sqrt(np.maximum(values, 0.0))


def _stationary(mean: float, variance: float, shape: tuple[int, int], correlation: Matrix) -> Prior:
    root = root_of(between_pixels(correlation, shape))
    return Prior(np.full(shape[0] * shape[1], mean), variance**0.5 * root)


def _power_lags(shape: tuple[int, int], exponent: float) -> Matrix:
    # On a torus of twice the size no two pixels meet round the back. The mean has the lowest frequency's power.
    down, across = np.fft.fftfreq(2 * shape[0]), np.fft.fftfreq(2 * shape[1])
    frequency = np.hypot(down[:, None], across[None, :])
    frequency[0, 0] = frequency[frequency > 0].min()
    lags = np.fft.ifft2(frequency**-exponent).real
    return lags / lags[0, 0]


def _diagonal(root: Vector, other: Matrix) -> Matrix:
    return root * other if other.ndim == 1 else root[:, None] * other
