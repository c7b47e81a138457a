"""How far an estimate is from the truth, how far it was expected to be, and what H leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse, stats

from scenes.scene import Estimator

from .estimator import Gain, Vector, expected_error, factorise, noise_covariance
from .prior import Prior

TRIM = 2
PEAK = 255.0
RANK_TOLERANCE = 1e-7  # of singular values, relative; their squares come from an eigenvalue problem in float64
SMALLEST_SSIM = 7  # pixels, the window of structural similarity


@dataclass(frozen=True)
class Observability:
    """Rank of H, the dimension of its null space, and its largest over its smallest singular value above zero."""

    rank: int
    null_space: int
    condition: float


@dataclass(frozen=True)
class Interval:
    """Expectation of the mean squared error given the image, and where it falls 99 times in 100."""

    mse: float
    low: float
    high: float


@dataclass(frozen=True)
class Error:
    """An estimate against the truth; None where the picture is too small for the measure."""

    mse: float
    trimmed_mse: float | None
    psnr: float | None
    ssim: float | None


def trimmed(image: Vector, shape: tuple[int, int]) -> float | None:
    """Mean of a map, (N,), without its border of 2 pixels; None where nothing is left."""
    inner = image.reshape(shape)[TRIM:-TRIM, TRIM:-TRIM]
    return float(inner.mean()) if inner.size else None


def compare(estimate: Vector, truth: Vector, shape: tuple[int, int]) -> Error:
    """Measured error of an estimate, both (N,): mean squares, PSNR (peak 255) and structural similarity."""
    squared = (estimate - truth) ** 2
    mse = float(squared.mean())
    psnr = 10 * float(np.log10(PEAK**2 / mse)) if mse > 0 else None
    ssim: float | None = None
    if min(shape) >= SMALLEST_SSIM:
        from skimage import metrics

        similarity = cast(Any, metrics).structural_similarity
        ssim = float(similarity(truth.reshape(shape), estimate.reshape(shape), data_range=PEAK))
    return Error(mse, trimmed(squared, shape), psnr, ssim)


def expected_given(gain: Gain, prior: Prior, truth: Vector, noise_variance: Vector) -> Interval:
    """What the mean squared error of this very image should be: |(I - A H)(f - f0)|^2 + trace(A Rvm A^T), over N.

    A photograph is no draw from the prior, so Eq. 5 does not answer for it. The interval takes the error as a gamma
    variate of the same mean and variance, the quadratic form's own: 4 b^T K b + 2 trace(K^2).
    """
    away = truth - prior.mean
    bias = away - gain.apply(gain.matrix @ away)
    covariance = noise_covariance(gain, noise_variance)
    mean = float(bias @ bias + np.trace(covariance))
    variance = float(4 * bias @ covariance @ bias + 2 * np.sum(covariance**2))
    if variance == 0:
        return Interval(mean / truth.size, mean / truth.size, mean / truth.size)
    shape, scale = mean**2 / variance, variance / mean
    low, high = (float(stats.gamma.ppf(level, shape, scale=scale)) for level in (0.005, 0.995))
    return Interval(mean / truth.size, low / truth.size, high / truth.size)


def observability(matrix: sparse.csr_array) -> Observability:
    """Rank and condition of H, from the eigenvalues of the smaller of H H^T and H^T H."""
    return _observability(_gram_values(matrix), matrix.shape[1])


def _gram_values(matrix: sparse.csr_array) -> NDArray[np.float64]:
    wide = matrix.shape[0] < matrix.shape[1]
    gram = (matrix @ matrix.T if wide else matrix.T @ matrix).toarray()
    return np.asarray(linalg.eigvalsh(gram, overwrite_a=True, check_finite=False), dtype=np.float64)


def _observability(values: NDArray[np.float64], unknowns: int) -> Observability:
    largest = float(values.max(initial=0.0))
    seen = values[values > RANK_TOLERANCE**2 * largest]
    condition = float(np.sqrt(largest / seen.min())) if seen.size else float("inf")
    return Observability(int(seen.size), unknowns - int(seen.size), condition)


@dataclass(frozen=True)
class Prediction:
    """What Eq. 5 promises of a camera before anything is rendered."""

    measurements: int
    unknowns: int
    rank: int
    null_space: int
    condition: float
    mse: float
    trimmed_mse: float | None
    trim: int = TRIM


def predict(
    matrix: sparse.csr_array, prior: Prior, actual: float, estimator: Estimator, shape: tuple[int, int]
) -> Prediction:
    """Expected squared error for noise of variance `actual`; the estimator expects what it is told, else the same.

    Without any noise the error is the limit of Eq. 5: the prior's part in the null space of H.
    """
    measurements, unknowns = matrix.shape
    seen = observability(matrix)
    believed = actual if estimator.noise_variance is None else estimator.noise_variance
    if believed > 0:
        gain = factorise(matrix, prior.variance, np.full(measurements, believed), estimator.method)
        variance = expected_error(gain, prior.variance, {"noise": np.full(measurements, actual)}).variance
    else:
        variance = _null_space_error(matrix, prior, seen.rank)
    mse = float(variance.mean())
    return Prediction(measurements, unknowns, seen.rank, seen.null_space, seen.condition, mse, trimmed(variance, shape))


def _null_space_error(matrix: sparse.csr_array, prior: Prior, rank: int) -> Vector:
    # As Rv goes to 0, I - A H becomes the projection onto the null space of H P0^1/2.
    scaled = sparse.csr_array(matrix.multiply(np.sqrt(prior.variance)[None, :]))
    _, vectors = linalg.eigh((scaled.T @ scaled).toarray(), overwrite_a=True, check_finite=False)
    unseen = vectors[:, : matrix.shape[1] - rank]
    return prior.variance * np.sum(unseen**2, axis=1)


def rows(prediction: Prediction) -> list[tuple[str, str]]:
    """The lines of the printed table: what, and how much."""
    deviation = float(np.sqrt(prediction.mse))
    inner = "the target is too small" if prediction.trimmed_mse is None else f"{prediction.trimmed_mse:.6g}"
    return [
        ("measurements", str(prediction.measurements)),
        ("unknowns", str(prediction.unknowns)),
        ("rank of H", str(prediction.rank)),
        ("null space", f"{prediction.null_space} dimensions"),
        ("condition of H", f"{prediction.condition:.4g} (largest over smallest singular value above zero)"),
        ("expected squared error (Eq. 5)", f"{prediction.mse:.6g} a pixel, a deviation of {deviation:.3g} of 255"),
        (f"  without a border of {prediction.trim} pixels", inner),
    ]
