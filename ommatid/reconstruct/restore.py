"""Reconstruct the image of a recorded stack, with error bars, the causes of its error, and the verdict on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import fft

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.workers import Workers
from ommatid.runtime.machine import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import RECORDED, Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

from .assumptions import Assumptions, assumptions_for, with_fallback
from .coarse_model import CAUSE as DETAIL
from .expected_error import ExpectedError, Interval
from .measured_error import MeasuredError, measure_error, trimmed_mean
from .method_choice import MethodChoice
from .methods.method import EstimationTask, Execution, Method, MethodResult, Prepared, total_variance
from .noise import Noise, UsablePixels, overexposed, undithered
from .output.run_json import ResidualPart, ResidualReport, SolverReport, VerdictReport
from .prior_fit import PriorFit
from .verdict.causes import likely_cause
from .verdict.residual import WhitenedResidual, residual_parts
from .verdict.verdict import ErrorCheck, judge, without_pixels

CORRECTABLE = 0.35  # share of the error by attenuation, up to which the first order of the noise of H serves
BEYOND = 0.1  # share of the error by the next order, likewise
LEAST_FREEDOMS = 5  # of a sample variance, from which its inverse has a variance
MORE_SAMPLES = {
    "points": "raise calibration.samples",
    "transport": "raise calibration.samples",
    RECORDED: "record more exposures of every point source",
}
BUDGET = ("null_space", "noise", "quantisation", "rendering", "calibration", "detail")


def verdict_of(
    stack: Stack,
    model: Model,
    assumed: Assumptions,
    result: MethodResult,
    error: MeasuredError | None,
    spurious: FloatArray,
) -> VerdictReport:
    """Return the verdict on a reconstruction.

    spurious : (N,) share of each pixel's apparent information that the noise of H may have produced
    """
    used, expected = assumed.usable.used, result.expected
    total = float(expected.variance.sum())
    check = ErrorCheck(
        mse=None if error is None else error.mse,
        interval=result.interval,
        predicted=expected.mse,
        variance_bound=result.solver.variance_bound,
        spurious=_spurious(spurious, expected) if total else 0.0,
        spurious_share=float(spurious.mean()),
        calibration_share=expected.parts.get("calibration", 0.0) / expected.mse if expected.mse else 0.0,
        hidden=expected.missing / expected.mse if expected.mse else 0.0,
        kurtosis=_kurtosis(assumed.method),
        fit_doubtful=assumed.fit is not None and assumed.fit.doubtful,
        fit_flat=assumed.fit is not None and assumed.fit.flat,
        noise_fitted=assumed.fit is not None and assumed.fit.noise_variance is not None,
        undithered=undithered(assumed.noise),
        rounding_share=_rounding_share(assumed.noise),
        pixels_used=int(used.sum()),
        overexposed=overexposed(assumed.method.task.model, assumed.usable),
        left_out=without_pixels(stack.camera, used),
        more_samples=MORE_SAMPLES.get(model.record["method"], "measure H more accurately"),
    )
    residual = _whitened(stack, model, assumed, result)
    if residual is None:
        return judge([], check, lambda _: "")

    def cause(beyond: Sequence[ResidualPart]) -> str:
        names = [(part.kind, part.name) for part in beyond if part.kind == beyond[0].kind]

        def excess(_: FloatArray, squares: FloatArray) -> float:
            parts = residual_parts(replace(residual, squares=squares), stack.camera)
            return sum(part.chi_squared - part.expected for part in parts if (part.kind, part.name) in names)

        return likely_cause(assumed.method, stack, excess)

    return judge(residual_parts(residual, stack.camera), check, cause)


def _kurtosis(method: Method) -> float:
    """Return the kurtosis of P0^-1/2 (f^ - f0) over the pixels, 3 for images of the prior; 0 without any contrast."""
    task = method.task
    precision = np.asarray(task.precision_on(task.shape))
    waves = fft.dctn((method.image - method.mean).reshape(task.shape), 2, norm="ortho") * np.sqrt(precision)
    waves[0, 0] = 0.0
    squares = np.square(fft.idctn(waves, 2, norm="ortho"))
    return float(np.square(squares).mean()) / (float(squares.mean()) ** 2 or np.inf)


def _rounding_share(noise: Noise) -> float:
    """Return the share of quantisation in the noise."""
    return float(np.mean(noise["quantisation"]) / np.mean(total_variance(noise))) if "quantisation" in noise else 0.0


def _spurious(share: FloatArray, expected: ExpectedError) -> float:
    """Return how wrong the noise of H may make Eq. 5, relative, beyond the attenuation that Eq. 5 then holds.

    share : (N,) of each pixel's apparent information that the noise of H may have produced
    """
    if expected.attenuation is None:
        return float(share @ expected.variance) / float(expected.variance.sum())
    corrected = expected.attenuation / expected.mse
    return corrected if corrected > CORRECTABLE or corrected * expected.second_order > BEYOND else 0.0


def _whitened(stack: Stack, model: Model, assumed: Assumptions, result: MethodResult) -> WhitenedResidual | None:
    """Return the whitened residual, None where a measurement has no expected noise."""
    expected_noise = assumed.method.task.expected_noise
    if result.residual_power is None or not expected_noise.size:
        return None
    total = total_variance(assumed.noise)
    return WhitenedResidual(
        squares=expected_noise * np.square(result.multipliers),
        power=result.residual_power,
        used=assumed.usable.used,
        spread=_spread(stack, assumed, total),
        shared=_shared(model, assumed, total),
        largest=max(1.0, float((total / expected_noise).max()), assumed.method.task.prior_ratio),
    )


def _spread(stack: Stack, assumed: Assumptions, total: FloatArray) -> FloatArray:
    """Return the relative variance of the noise variances, which the rendering estimates from few passes."""
    freedoms = max(int(stack.record.get("passes") or 0) - 1, LEAST_FREEDOMS)
    if not assumed.noise["rendering"].any():
        return np.zeros(total.size)
    share = np.divide(assumed.noise["rendering"], total, out=np.zeros(total.size), where=total > 0)
    np.square(share, out=share)
    share *= 2 / (freedoms - 4)
    return share


def _shared(model: Model, assumed: Assumptions, total: FloatArray) -> FloatArray:
    """Return the share of the noise that the few errors per sub-imager of a fitted geometry cause."""
    if not model.record.get("fit") or "calibration" not in assumed.noise:
        return np.zeros(total.size)
    return np.divide(assumed.noise["calibration"], total, out=np.zeros(total.size), where=total > 0)


@dataclass(frozen=True)
class Reconstruction:
    """An estimate with its expected error (Eq. 5), and its measured error where the truth is known.

    prior : as assumed, fitted or described;  noise : variances by cause, (pixels used,) each
    given_estimate : computes the mean squared error to expect if the image is the estimate, None where that is unknown
    spurious_information : mean share of a pixel's apparent information that the noise of H may have produced
    task : what the estimator was given, H and the expected noise included
    """

    result: MethodResult
    choice: MethodChoice
    prior: PriorTable
    trimmed_mse: float | None
    residual: ResidualReport | None
    given_estimate: Callable[[], float | None]
    shape: tuple[int, int]
    usable: UsablePixels
    noise: Noise
    fit: PriorFit | None
    spurious_information: float
    seconds: float
    truth: FloatArray | None
    error: MeasuredError | None
    task: EstimationTask
    verdict: VerdictReport

    def __repr__(self) -> str:
        """Return size, method and error in one line."""
        error = f"expected error {self.expected.mse**0.5:.3g} rms"
        return f"<Reconstruction: {self.shape[0]} x {self.shape[1]} pixels, {self.choice.method}, {error}>"

    @property
    def estimate(self) -> FloatArray:
        """f^, (N,)."""
        return self.result.image

    @property
    def expected(self) -> ExpectedError:
        """Eq. 5."""
        return self.result.expected

    @property
    def interval(self) -> Interval | None:
        """Expected error of this image, None where the truth is not known."""
        return self.result.interval

    @property
    def solver(self) -> SolverReport:
        """The form that ran, with the bounds on its numerical error."""
        return self.result.solver

    def budget(self) -> dict[str, float]:
        """Return the parts of the expected squared error by cause; they add up to it, an absent effect has 0."""
        parts = {"null_space": self.expected.missing, **self.expected.parts}
        return {name: parts.get(name, 0.0) for name in BUDGET} | parts

    def region(self, corner: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
        """Return the mean of the estimate in a region and its standard deviation (Eq. 5).

        Raises InputError if the region lies outside the image.
        """
        check_region(corner, size, self.shape)
        weights = np.zeros(self.shape)
        weights[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = 1 / (size[0] * size[1])
        variance = self.result.variance_of_sum(weights.ravel())
        return float(weights.ravel() @ self.estimate), variance**0.5


def check_region(corner: tuple[int, int], size: tuple[int, int], shape: tuple[int, int]) -> None:
    """Raise InputError unless a region of `size` at `corner` lies inside an image of `shape`."""
    ends = corner[0] + size[0], corner[1] + size[1]
    if min(*corner) < 0 or min(*size) < 1 or ends[0] > shape[0] or ends[1] > shape[1]:
        raise InputError(
            f"a region of {size[0]} x {size[1]} pixels at row {corner[0]}, column {corner[1]} does not lie inside"
            f" an image of {shape[0]} x {shape[1]}"
        )


def check_camera(camera: Camera, model: Model, names: tuple[Path | str, Path | str]) -> None:
    """Raise InputError, naming the first difference, unless the camera of a stack or scene is the model's.

    names : of the stack or scene, and of the model
    """
    rows, columns = camera.with_grid_of_matrix.shape
    if camera.has_detail and model.camera.shape != (rows, columns):
        raise InputError(
            f"{names[0]} and {names[1]} do not belong together: target.shape {list(camera.shape)} and"
            f" target.detail {camera.detail} of {names[0]} need H on {rows} x {columns} pixels, {names[1]} has"
            f" {model.camera.rows} x {model.camera.columns}; calibrate the scene of {names[0]}"
        )
    recorded, calibrated = camera.with_grid_of_matrix.describe(), model.camera.describe()
    for key in [*recorded, *(key for key in calibrated if key not in recorded)]:
        if recorded.get(key) != calibrated.get(key):
            raise InputError(
                f"{names[0]} and {names[1]} do not belong together: {key} is {recorded.get(key, 'absent')} in"
                f" {names[0]} and {calibrated.get(key, 'absent')} in {names[1]}; calibrate the scene of {names[0]}"
            )


@one_thread()
def restore(
    stack: Stack,
    model: Model,
    truth: FloatArray | None = None,
    workers: Workers | None = None,
    progress: Progress = no_progress,
    prepared: Prepared | None = None,
) -> Reconstruction:
    """Reconstruct a stack with a model as the stack's scene says (Wood et al., Eq. 4 and Eq. 5).

    truth : (N,) or (pixels of the world,), or None;  workers : for tiles, absent: threads of this process
    prepared : what other frames of this model left, None for a frame by itself
    Raises InputError if memory does not suffice, if no method reaches the tolerance of the scene, or if the noise of a
    [sensor] is to be fitted.
    """
    execution = Execution(workers, progress, prepared or Prepared(model))
    return with_fallback(stack, model, lambda choice: _restored(stack, model, truth, choice, execution))


def _restored(
    stack: Stack, model: Model, truth: FloatArray | None, choice: MethodChoice, execution: Execution
) -> Reconstruction:
    start, shape = perf_counter(), stack.camera.shape
    assumed = assumptions_for(stack, model, choice, execution)
    result, task = assumed.result(truth_for(assumed.method, truth, stack.camera)), assumed.method.task
    truth = None if truth is None else _image(truth, stack.camera)
    error = None if truth is None else measure_error(result.image, truth, shape)
    spurious = _spurious_information(task, result.expected)
    verdict = verdict_of(stack, model, assumed, result, error, spurious)
    whole = verdict.parts[0] if verdict.parts else None  # chi-squared of all measurements
    return Reconstruction(
        result=result,
        choice=choice,
        prior=assumed.prior,
        trimmed_mse=trimmed_mean(result.expected.variance, shape),
        residual=None if whole is None else ResidualReport.model_validate(whole),
        given_estimate=partial(_given_estimate, assumed.method, result.expected),
        shape=shape,
        usable=assumed.usable,
        noise=assumed.noise,
        fit=assumed.fit,
        spurious_information=float(spurious.mean()),
        seconds=perf_counter() - start,
        truth=truth,
        error=error,
        task=task,
        verdict=verdict,
    )


def truth_for(method: Method, truth: FloatArray | None, camera: Camera) -> FloatArray | None:
    """Return what a method compares its estimate with: the world where it takes detail into account, else f."""
    return truth if truth is None or method.task.finer > 1 else _image(truth, camera)


def _image(truth: FloatArray, camera: Camera) -> FloatArray:
    """Return f, (N,), from itself or from the world, (pixels of the world,)."""
    if truth.size == camera.unknowns:
        return truth
    return averaged(truth.reshape(camera.world.shape), camera.detail).ravel()


def _given_estimate(method: Method, expected: ExpectedError) -> float | None:
    """Return the mean squared error to expect if the image is the estimate; None where no operators are known.

    It is |(I - A H)(f^ - f0)|^2 + trace(A Rvm A^T), over N, as for a known image.
    """
    operators = method.operators()
    if operators is None:
        return None
    try:
        bias = method.task.of_f(operators.hidden(method.image - method.mean))
    except InputError:  # those of tiles are conjugate gradients, which not every frame allows
        return None
    noisy = sum(part for cause, part in expected.parts.items() if cause != DETAIL)
    return float(np.square(bias).mean()) + noisy


def _spurious_information(task: EstimationTask, expected: ExpectedError) -> FloatArray:
    """Return the share of each pixel's apparent information that the noise of H may have produced: (N,)."""
    model, count = task.model, expected.variance.size
    if not model.variance.any():
        return np.zeros(count)
    noise = np.full(model.measurements, np.inf)
    noise[task.used] = task.expected_noise
    with np.errstate(divide="ignore", invalid="ignore"):  # without noise and without uncertainty of H
        information = task.finer**2 * task.of_f(model.spurious_information(noise))
        return np.nan_to_num(information * expected.variance)
