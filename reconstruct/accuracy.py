"""How far an estimate is from the truth, how far it was expected to be, and what H leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from scenes.errors import InputError
from scenes.scene import Estimator

from .estimator import factorise
from .expected import expected_error, widths
from .forms.form import Vector
from .forms.svd import svd
from .prior import Prior
from .problem import Problem

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
    """What Eq. 5 promises of a camera before anything is rendered.

    rank, null_space, condition : of H, None for frames
    degrees_of_freedom : trace of A H;  resolution : median width of the averaging kernel, in pixels of f
    """

    measurements: int
    unknowns: int
    rank: int | None
    null_space: int | None
    condition: float | None
    mse: float
    trimmed_mse: float | None
    trim: int
    degrees_of_freedom: float
    resolution: float | None
    method: str


def predict(
    matrix: sparse.csr_array, prior: Prior, actual: float, estimator: Estimator, shape: tuple[int, int]
) -> Prediction:
    """Expected squared error for noise of variance `actual`; the estimator expects what it is told, else the same.

    Without any noise the error is the limit of Eq. 5: the prior's part in the null space of H.
    Raises InputError where the estimator is to find the noise from a stack, or where no form is right.
    """
    measurements, unknowns = matrix.shape
    seen = observability(matrix)
    if estimator.noise_variance == "fit":
        raise InputError("estimator.noise_variance 'fit' takes a recorded stack; set a number to predict without one")
    believed = actual if estimator.noise_variance is None else float(estimator.noise_variance)
    if believed > 0:
        problem = Problem(matrix, prior, np.full(measurements, believed))
        form, solver = factorise(problem, estimator.method, estimator.tolerance)
        expected = expected_error(form, {"noise": np.full(measurements, actual)})
        method, variance, resolved = solver.method, expected.variance, expected.resolved
    else:
        limit = svd(Problem(matrix, prior, np.ones(measurements)))
        method, variance, resolved = limit.name, limit.expected_variance(0.0, actual), limit.resolved()
    mse, width = float(variance.mean()), float(np.median(widths(resolved)))
    return Prediction(
        measurements,
        unknowns,
        seen.rank,
        seen.null_space,
        seen.condition,
        mse,
        trimmed(variance, shape),
        TRIM,
        float(resolved.sum()),
        width if isfinite(width) else None,
        method,
    )


def rows(prediction: Prediction) -> list[tuple[str, str]]:
    """The lines of the printed table: what, and how much."""
    deviation = float(np.sqrt(prediction.mse))
    inner = "the target is too small" if prediction.trimmed_mse is None else f"{prediction.trimmed_mse:.6g}"
    width = "nothing is resolved" if prediction.resolution is None else f"{prediction.resolution:.3g} pixels of f"
    return [
        ("measurements", str(prediction.measurements)),
        ("unknowns", str(prediction.unknowns)),
        *_rank_rows(prediction),
        ("expected squared error (Eq. 5)", f"{prediction.mse:.6g} a pixel, a deviation of {deviation:.3g} of 255"),
        (f"  without a border of {prediction.trim} pixels", inner),
        ("degrees of freedom", f"{prediction.degrees_of_freedom:.6g} of {prediction.unknowns}"),
        ("resolution, median", width),
        ("form of the estimator", prediction.method),
    ]


def _rank_rows(prediction: Prediction) -> list[tuple[str, str]]:
    if prediction.rank is None or prediction.condition is None:
        return [("rank of H", "not computed for a frame of this size")]
    return [
        ("rank of H", str(prediction.rank)),
        ("null space", f"{prediction.null_space} dimensions"),
        ("condition of H", f"{prediction.condition:.4g} (largest over smallest singular value above zero)"),
    ]
