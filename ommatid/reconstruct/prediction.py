"""The expected error of a camera before anything is recorded (Wood et al., Eq. 5), and what its H leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from scipy import linalg, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.tables.estimation import EstimatorTable

from .estimator.estimate import factorise
from .expected_error import ExpectedError, expected_error
from .measured_error import TRIM, trimmed_mean
from .method_choice import METHODS, MethodChoice
from .methods.level import variance_of
from .methods.method import EstimationTask, Execution
from .noise import at_used, uniform
from .prior import Prior
from .problem import Form, Problem, gram

PRIOR_ALONE = 0.9  # of the prior's variance: error from which measurements bring next to nothing
NOISELESS = 1e-12  # of a measurement's prior variance: noise in place of none that an estimator expects where some is
RANK_TOLERANCE = 1e-7  # of singular values, relative; their squares come from an eigenvalue problem in float64


@dataclass(frozen=True)
class Observability:
    """Rank of H, the dimension of its null space, and its largest over its smallest singular value above zero."""

    rank: int
    null_space: int
    condition: float


@dataclass(frozen=True)
class Prediction:
    """Expected error (Eq. 5) of a camera, averaged over the pixels, and the properties of its H.

    rank, null_space, condition : of H, None for frames
    trimmed_mse : without a border of `trim` pixels, None where nothing is left
    degrees_of_freedom : trace of A H;  resolution : median width of the averaging kernel, in pixels of f
    misalignment : the part of `mse` that the camera's tolerance brings, None where there is none or it is not known
    prior_variance : of a pixel, the error where nothing is recovered
    mse_for_picture : expected error of the scene's picture, which is no draw of the prior
    interval : ends of what holds its measured error in 99 of 100 runs, None where that is not known
    budget : parts of `mse` by cause, which add up to it
    assumes : what the prediction takes for granted, in sentences
    as_designed, calibrated : `mse` with H as designed and with a calibrated H, where the camera has a tolerance
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
    prior_variance: float | None = None
    mse_for_picture: float | None = None
    interval: tuple[float, float] | None = None
    budget: dict[str, float] | None = None
    assumes: tuple[str, ...] = ()
    as_designed: float | None = None
    calibrated: float | None = None

    @classmethod
    def of(
        cls,
        variance: FloatArray,
        expected: ExpectedError,
        seen: Observability | None,
        shape: tuple[int, int],
        **others: Any,
    ) -> Prediction:
        """Return the prediction of an estimate; variance : (N,) with all that adds to Eq. 5; seen : None for frames."""
        rank, null_space, condition = (None, None, None) if seen is None else astuple(seen)
        return cls(
            unknowns=variance.size,
            rank=rank,
            null_space=null_space,
            condition=condition,
            mse=float(variance.mean()),
            trimmed_mse=trimmed_mean(variance, shape),
            trim=TRIM,
            degrees_of_freedom=expected.degrees_of_freedom,
            resolution=expected.median_width,
            **others,
        )

    @property
    def recovers_nothing(self) -> bool:
        """True if the error is that of the prior alone, to a tenth."""
        return self.prior_variance is not None and self.mse >= PRIOR_ALONE * self.prior_variance


def observability(matrix: sparse.csr_array) -> Observability:
    """Return rank and condition of H, from the eigenvalues of the smaller of H H^T and H^T H."""
    wide = matrix.shape[0] < matrix.shape[1]
    square = gram(sparse.csr_array(matrix.T) if wide else matrix)
    values: FloatArray = np.asarray(linalg.eigvalsh(square, overwrite_a=True, check_finite=False), dtype=np.float64)
    largest = float(values.max(initial=0.0))
    seen = values[values > RANK_TOLERANCE**2 * largest]
    condition = float(np.sqrt(largest / seen.min())) if seen.size else float("inf")
    return Observability(int(seen.size), matrix.shape[1] - int(seen.size), condition)


def predict(
    matrix: sparse.csr_array,
    prior: Prior,
    actual: float | FloatArray,
    estimator: EstimatorTable,
    shape: tuple[int, int],
    misalignment_variance: Callable[[Form, BoolArray], FloatArray] | None = None,
    prior_ratio: float = 1.0,
    level: float = 0.0,
) -> Prediction:
    """Predict the error of one dense problem with noise of variance `actual`.

    The estimator expects `estimator.noise_variance`, or the actual noise where that is not set. Without any noise the
    error is the prior's part in the null space of H. Where an estimator expects none of the noise that there is, it is
    the limit of Eq. 5 for ever less expected noise.

    actual : one variance for all measurements, or (M,); NaN leaves a measurement out
    prior : as the estimator assumes it;  prior_ratio : the actual variance of the pixels over that of `prior`
    misalignment_variance : from a form and the measurements used, (M,), to what misalignment adds, (N,); asked where
        the estimator expects noise
    level : standard deviation of the image's common level, 0 where it is known or where there is no noise
    Raises InputError where the noise is to be fitted to a stack, or where no form is right.
    """
    noise, expected_noise, used = _noises(actual, matrix.shape[0], estimator)
    matrix = matrix if used.all() else sparse.csr_array(matrix[used])
    seen, added = observability(matrix), None
    if noise.any() and not (expected_noise > 0).all():
        signal = float((abs(matrix) @ np.sqrt(prior.variance)).max(initial=0.0))
        expected_noise = uniform(NOISELESS * signal**2, noise.size)
    form, solver = factorise(Problem(matrix, prior, expected_noise), estimator.tolerance)
    expected = expected_error(form, {"noise": noise / prior_ratio})
    variance = prior_ratio * expected.variance
    if level and form.problem.noisy:
        variance = variance + _by_level(form, level)
    if misalignment_variance is not None and form.problem.noisy:
        added = misalignment_variance(form, used)
        variance = variance + added
    return Prediction.of(
        variance,
        expected,
        seen,
        shape,
        measurements=noise.size,
        method=solver.method,
        misalignment=None if added is None else float(added.mean()),
        prior_variance=prior_ratio * float(prior.variance.mean()),
    )


def _by_level(form: Form, level: float) -> FloatArray:
    """Return what an unknown level adds to Eq. 5 for the expected noise: (N,)."""
    prior, matrix = form.problem.prior, form.problem.matrix
    constant = np.ones(matrix.shape[1])
    wave = float(np.mean(prior.apply_root(prior.apply_root_transposed(constant))))
    response = constant - form.gain(matrix @ constant)
    return variance_of(response, wave, level**2) * np.square(response)


def predict_frame(choice: MethodChoice, model: Model, camera: Camera, actual: float | FloatArray) -> Prediction:
    """Predict the error by the method chosen; rank, null space and condition of H where one dense problem serves.

    Use it for frames, and where the world is finer than f.

    camera : on f's grid;  actual : one variance for all measurements, or (M,); NaN leaves a measurement out
    Raises InputError where the noise is to be fitted to a stack, or where the estimator has no noise to expect.
    """
    scene = model.scene
    noise, expected_noise, used = _noises(actual, model.measurements, scene.estimator)
    if not (expected_noise > 0).all():
        raise InputError(
            f"{camera.unknowns} pixels are predicted with noise alone; set noise.variance or estimator.noise_variance"
            " above 0"
        )
    recorded = model.forward(np.full(model.unknowns, scene.prior.mean))
    task = EstimationTask(
        model,
        recorded,
        used,
        expected_noise,
        scene.assumed_prior,
        scene.estimator,
        scene.tiles,
        scene.prior_ratio,
        finer=model.camera.rows // camera.rows,
    )
    result = METHODS[choice.method](task, Execution()).result({"noise": noise}, None)
    seen = observability(model.matrix[used]) if choice.method == "dense" else None
    return Prediction.of(
        result.expected.variance,
        result.expected,
        seen,
        camera.shape,
        measurements=noise.size,
        method=result.solver.method,
        prior_variance=scene.prior.variance,
        budget={"null_space": result.expected.missing, **result.expected.parts} if camera.has_detail else None,
    )


def _noises(
    actual: float | FloatArray, measurements: int, estimator: EstimatorTable
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return actual and expected noise of the measurements used, and which of all are, (M,). Raises InputError."""
    setting = estimator.noise_variance
    if isinstance(setting, str):
        raise InputError("estimator.noise_variance 'fit' takes a recorded stack; set a number to predict without one")
    noise = actual if isinstance(actual, np.ndarray) else uniform(actual, measurements)
    used = np.isfinite(noise)
    noise = at_used(noise, used)
    return noise, noise if setting is None else uniform(setting, noise.size), used
