"""Methods that expect a misaligned camera: with additional noise, or with an H fitted to the stack.

Both start from H of the camera as designed, and need a dense problem.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.model import Model

from ..estimator.estimate import Estimate, estimate
from ..expected_error import ExpectedError, Interval, variance_of_sum
from ..methods.dense_method import DenseMethod, residual_power
from ..methods.method import Method, MethodResult
from .alignment import Alignment, align
from .robust_noise import CAUSE, Whitening, robust_error, robust_noise, whitening


class RobustMethod(Method):
    """Rv holds E[dH P0 dH^T] of every sub-imager's misalignment within its tolerance."""

    @cached_property
    def _solved(self) -> tuple[Whitening, Estimate]:
        task = self.task
        prior, camera = task.prior_on(task.shape), task.model.camera
        misaligned = robust_noise(camera, prior)
        white = whitening(camera, misaligned, task.expected_noise, task.used)
        problem = white.problem(misaligned.matrix[task.used], prior)
        recorded = white.vector(task.recorded[task.used])
        return white, estimate(problem, recorded, task.settings.tolerance)

    def estimate_image(self) -> FloatArray:
        """Return f^ alone: (N,)."""
        return self._solved[1].image

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error with the given noise and misalignment as its tolerance says.

        There is no interval for a given image: misalignment acts on it otherwise than on images of the prior.
        """
        del truth
        white, solved = self._solved
        unit = np.ones(self.task.expected_noise.size)
        expected = robust_error(solved.form, white, noise)
        return MethodResult(
            solved.image,
            solved.multipliers / np.sqrt(self.task.expected_noise),  # their squares times the noise are chi-squared
            solved.solver,
            expected,
            None,
            lambda weights: variance_of_sum(solved.form, weights, unit),
            residual_power(solved.form, unit, expected.leverage, None),
        )


class AlignedMethod(Method):
    """H is that of the misalignments which are most likely given the stack."""

    @cached_property
    def alignment(self) -> Alignment:
        """Fitted misalignments and their remaining uncertainty."""
        task = self.task
        prior = task.prior_on(task.shape)
        return align(task.model.camera, task.recorded[task.used], task.expected_noise, prior, task.used)

    @cached_property
    def _dense(self) -> DenseMethod:
        return DenseMethod(replace(self.task, model=_aligned_model(self.task.model, self.alignment)), self.execution)

    def estimate_image(self) -> FloatArray:
        """Return f^ alone: (N,)."""
        return self._dense.estimate_image()

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error with the given noise; the remaining uncertainty of the fit adds to it."""
        result, alignment = self._dense.result_for_assumed_prior(noise, truth), self.alignment
        added = float(alignment.variance.mean())
        expected = result.expected

        def variance_of_sum(weights: FloatArray) -> float:
            return result.variance_of_sum(weights) + alignment.variance_of_sum(weights)

        return replace(
            result,
            expected=ExpectedError(
                expected.variance + alignment.variance,
                expected.missing,
                {**expected.parts, CAUSE: added},
                expected.resolved,
            ),
            interval=None if result.interval is None else _wider(result.interval, added),
            variance_of_sum=variance_of_sum,
        )


def _aligned_model(model: Model, alignment: Alignment) -> Model:
    entries = alignment.matrix.nnz
    return replace(
        model,
        stored=alignment.matrix,
        variance=np.zeros(entries),
        batches=np.zeros((0, entries), np.float32),
        record={**model.record, "method": "fitted"},
    )


def _wider(interval: Interval, added: float) -> Interval:
    """Return an interval with one more error of mean square `added`, which may be almost zero or several times that."""
    mean = interval.mse + added
    return Interval(mean, interval.low, interval.high * mean / interval.mse)
