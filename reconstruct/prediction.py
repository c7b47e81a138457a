"""How far an estimate is from the truth, how far it was expected to be, and what H leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.errors import InputError
from ommatid.scenes.tables.estimation import EstimatorTable

from .estimator.estimate import factorise
from .expected_error import expected_error, widths
from .forms.form import Form, Vector
from .forms.svd import Svd, svd
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
class MeasuredError:
    """An estimate against the truth; None where the picture is too small for the measure."""

    mse: float
    trimmed_mse: float | None
    psnr: float | None
    ssim: float | None


def trimmed(image: Vector, shape: tuple[int, int]) -> float | None:
    """Mean of a map, (N,), without its border of 2 pixels; None where nothing is left."""
    inner = image.reshape(shape)[TRIM:-TRIM, TRIM:-TRIM]
    return float(inner.mean()) if inner.size else None


def compare(estimate: Vector, truth: Vector, shape: tuple[int, int]) -> MeasuredError:
    """Measured error of an estimate, both (N,): mean squares, PSNR (peak 255) and structural similarity."""
    squared = (estimate - truth) ** 2
    mse = float(squared.mean())
    psnr = 10 * float(np.log10(PEAK**2 / mse)) if mse > 0 else None
    ssim: float | None = None
    if min(shape) >= SMALLEST_SSIM:
        from skimage import metrics

        similarity = cast(Any, metrics).structural_similarity
        ssim = float(similarity(truth.reshape(shape), estimate.reshape(shape), data_range=PEAK))
    return MeasuredError(mse, trimmed(squared, shape), psnr, ssim)


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
    misalignment : the part of `mse` that the camera's tolerance brings, None where there is none or it is not known
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
    misalignment: float | None = None

    def describe(self) -> dict[str, Any]:
        """In JSON's types; what a tolerance brings only where there is one."""
        found = asdict(self)
        if self.misalignment is None:
            del found["misalignment"]
        return found


def predict(
    matrix: sparse.csr_array,
    prior: Prior,
    actual: float | Vector,
    estimator: EstimatorTable,
    shape: tuple[int, int],
    tolerated: Callable[[Form, NDArray[np.bool_]], Vector] | None = None,
) -> Prediction:
    """Expected squared error for noise of variance `actual`; the estimator expects what it is told, else the same.

    actual : of every measurement the same, or (M,); NaN where a measurement tells nothing and is left out
    tolerated : what misalignment adds, (N,), given which measurements tell something; where there is a tolerance and
        the estimator has noise to expect
    Without any noise the error is the limit of Eq. 5: the prior's part in the null space of H.
    Raises InputError where the estimator is to find the noise from a stack, or where no form is right.
    """
    matrix, noise, telling = _telling(matrix, actual)
    measurements, unknowns = matrix.shape
    seen = observability(matrix)
    if estimator.noise_variance == "fit":
        raise InputError("estimator.noise_variance 'fit' takes a recorded stack; set a number to predict without one")
    told = estimator.noise_variance
    believed = noise if told is None else np.full(measurements, float(told))
    if (believed > 0).all():
        form, solver = factorise(Problem(matrix, prior, believed), estimator.method, estimator.tolerance)
        expected = expected_error(form, {"noise": noise})
        method, variance, resolved = solver.method, expected.variance, expected.resolved
        more = None if tolerated is None else tolerated(form, telling)
    else:
        limit, more = svd(Problem(matrix, prior, np.ones(measurements))), None
        method, variance, resolved = limit.name, _in_the_limit(limit, noise), limit.resolved()
    variance = variance if more is None else variance + more
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
        None if more is None else float(more.mean()),
    )


def _telling(matrix: sparse.csr_array, actual: float | Vector) -> tuple[sparse.csr_array, Vector, NDArray[np.bool_]]:
    """H and the noise of the measurements that tell something, and which those are."""
    noise = actual if isinstance(actual, np.ndarray) else np.full(matrix.shape[0], actual)
    telling = np.isfinite(noise)
    return (matrix if telling.all() else sparse.csr_array(matrix[telling])), noise[telling], telling


def _in_the_limit(limit: Svd, noise: Vector) -> Vector:
    """Eq. 5 of an estimator that believes what it sees, (N,); `limit` is of noise 1, `noise` what it really is."""
    if not np.ptp(noise):
        return limit.expected_variance(0.0, float(noise.max(initial=0.0)))
    spread, rank = limit.problem.prior.apply_root, limit.rank
    unseen = np.square(spread(limit.right[:, rank:])).sum(axis=1)
    gain = spread(limit.right[:, :rank] / limit.values[:rank]) @ limit.left.T
    return np.asarray(unseen + np.square(gain) @ noise)


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
        *_misalignment_rows(prediction),
        (f"  without a border of {prediction.trim} pixels", inner),
        ("degrees of freedom", f"{prediction.degrees_of_freedom:.6g} of {prediction.unknowns}"),
        ("resolution, median", width),
        ("form of the estimator", prediction.method),
    ]


def _misalignment_rows(prediction: Prediction) -> list[tuple[str, str]]:
    if prediction.misalignment is None:
        return []
    return [("  of it by misalignment", f"{prediction.misalignment:.6g}, within camera.tolerance and on trust")]


def _rank_rows(prediction: Prediction) -> list[tuple[str, str]]:
    if prediction.rank is None or prediction.condition is None:
        return [("rank of H", "not computed for a frame, nor where misalignment counts as noise")]
    return [
        ("rank of H", str(prediction.rank)),
        ("null space", f"{prediction.null_space} dimensions"),
        ("condition of H", f"{prediction.condition:.4g} (largest over smallest singular value above zero)"),
    ]
