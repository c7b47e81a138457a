"""The verdict on a reconstruction, from its residual, its error and the assumptions behind it."""

from __future__ import annotations

from functools import partial

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

from .assumptions import Assumptions
from .expected_error import ExpectedError
from .measured_error import MeasuredError
from .methods.method import MethodResult, is_uniform, total_variance
from .misalignment.robust_noise import CAUSE
from .noise import uniform
from .output.run_json import ResidualPart, VerdictReport
from .verdict.causes import evidence_of, without_pixels
from .verdict.residual_parts import WhitenedResidual, residual_parts
from .verdict.verdict import ErrorCheck, judge

CORRECTABLE = 0.35  # share of the error by attenuation, up to which the first order of the noise of H serves
BEYOND = 0.1  # share of the error by the next order, likewise
LEAST_FREEDOMS = 5  # of a sample variance, from which its inverse has a variance


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
        variance_bound=result.solver.variance_bound,
        spurious=_spurious(spurious, expected) if total else 0.0,
        spurious_share=float(spurious.mean()),
        calibration_share=expected.parts.get("calibration", 0.0) / expected.mse if expected.mse else 0.0,
        fit_doubtful=assumed.fit is not None and assumed.fit.doubtful,
        noise_fitted=assumed.fit is not None and assumed.fit.noise_variance is not None,
        pixels_used=int(used.sum()),
        left_out=without_pixels(stack.camera, used),
    )
    light = partial(assumed.method.task.model.light, result.image)
    evidence = evidence_of(stack, model, used, light, assumed.prior.kind == "independent")
    return judge(_parts(stack, model, assumed, result), evidence, check)


def _spurious(share: FloatArray, expected: ExpectedError) -> float:
    """Return how wrong the noise of H may make Eq. 5, relative, beyond the attenuation that Eq. 5 then holds.

    share : (N,) of each pixel's apparent information that the noise of H may have produced
    """
    if expected.attenuation is None:
        return float(share @ expected.variance) / float(expected.variance.sum())
    corrected = expected.attenuation / expected.mse
    return corrected if corrected > CORRECTABLE or corrected * expected.second_order > BEYOND else 0.0


def _parts(stack: Stack, model: Model, assumed: Assumptions, result: MethodResult) -> list[ResidualPart]:
    """Return chi-squared by part, nothing where a measurement has no expected noise."""
    expected_noise = assumed.method.task.expected_noise
    if result.residual_power is None or not expected_noise.size:
        return []
    total = total_variance(assumed.noise)
    residual = WhitenedResidual(
        squares=expected_noise * np.square(result.multipliers),
        power=result.residual_power,
        used=assumed.usable.used,
        spread=_spread(stack, assumed, total),
        shared=_shared(model, assumed, total, result),
        largest=max(1.0, _largest_ratio(total, expected_noise), assumed.method.task.prior_ratio),
    )
    return residual_parts(residual, stack.camera)


def _spread(stack: Stack, assumed: Assumptions, total: FloatArray) -> FloatArray:
    """Return the relative variance of the noise variances, which the rendering estimates from few passes."""
    freedoms = max(int(stack.record.get("passes") or 0) - 1, LEAST_FREEDOMS)
    if not assumed.noise["rendering"].any():
        return uniform(0.0, total.size)
    share = np.divide(assumed.noise["rendering"], total, out=np.zeros(total.size), where=total > 0)
    return np.square(share) * 2 / (freedoms - 4)


def _largest_ratio(total: FloatArray, expected: FloatArray) -> float:
    """Return the largest ratio of the actual to the expected noise variance."""
    if is_uniform(total) and is_uniform(expected):
        total, expected = total[:1], expected[:1]
    return float((total / expected).max())


def _shared(model: Model, assumed: Assumptions, total: FloatArray, result: MethodResult) -> FloatArray:
    """Return the share of the noise that a few errors per sub-imager cause: a fitted geometry, or misalignment."""
    if CAUSE in result.expected.parts and result.interval is None:
        return np.ones(total.size)
    if not model.record.get("fit") or "calibration" not in assumed.noise:
        return uniform(0.0, total.size)
    return np.divide(assumed.noise["calibration"], total, out=np.zeros(total.size), where=total > 0)
