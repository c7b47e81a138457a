"""Ways to an estimate that expect a misaligned camera: with more noise, or by finding how its sub-imagers stand.

Both work on the H of the camera as drawn, and need a dense problem.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from ommatid.scenes.model import Model

from ..estimator.estimate import Estimate, estimate
from ..expected_error import ExpectedError, Interval, variance_of_sum
from ..methods.dense_method import DenseMethod
from ..methods.method import Method, MethodResult, Vector
from .alignment import Alignment, align
from .robust_noise import Whitening, robust_error, robust_noise, whitening

CAUSE = "misalignment"


class RobustMethod(Method):
    """Rv holds E[dH P0 dH^T] of every sub-imager's misalignment within its tolerance."""

    @cached_property
    def _solved(self) -> tuple[Whitening, Estimate]:
        task = self.task
        prior, camera = task.prior_on(task.shape), task.model.camera
        wrong = robust_noise(camera, prior)
        white = whitening(camera, wrong, task.expected_noise, task.used)
        problem = white.problem(wrong.matrix[task.used], prior)
        recorded = white.vector(task.recorded[task.used])
        return white, estimate(problem, recorded, task.settings.method, task.settings.tolerance)

    def estimate_image(self) -> Vector:
        """f^ alone: (N,)."""
        return self._solved[1].image

    def result(self, noise: dict[str, Vector], truth: Vector | None) -> MethodResult:
        """The estimate and its error where the noise is as given, and misalignment as its tolerance draws it.

        There is no interval for a given image: what misalignment does to it is not what it does to the prior's images.
        """
        del truth
        white, found = self._solved
        unit = np.ones(self.task.expected_noise.size)
        return MethodResult(
            found.image,
            found.multipliers
            / np.sqrt(self.task.expected_noise),  # so that weighted with `believed` they are chi-squared
            found.solver,
            robust_error(found.form, white, noise, CAUSE),
            None,
            lambda weights: variance_of_sum(found.form, weights, unit),
        )


class AlignedMethod(Method):
    """H is that of the misalignments which the stack itself makes most likely."""

    @cached_property
    def alignment(self) -> Alignment:
        """Where the sub-imagers are found to stand."""
        task = self.task
        prior = task.prior_on(task.shape)
        return align(task.model.camera, task.recorded[task.used], task.expected_noise, prior, task.used)

    @cached_property
    def _dense(self) -> DenseMethod:
        return DenseMethod(replace(self.task, model=_with(self.task.model, self.alignment)), self.execution)

    def estimate_image(self) -> Vector:
        """f^ alone: (N,)."""
        return self._dense.estimate_image()

    def result(self, noise: dict[str, Vector], truth: Vector | None) -> MethodResult:
        """The estimate and its error where the noise is as given; what is left unknown of misalignment adds to it."""
        found, left = self._dense.result(noise, truth), self.alignment
        more = float(left.variance.mean())

        def of_sum(weights: Vector) -> float:
            return found.variance_of_sum(weights) + left.variance_of_sum(weights)

        expected = found.expected
        return replace(
            found,
            expected=ExpectedError(
                expected.variance + left.variance, expected.missing, {**expected.parts, CAUSE: more}, expected.resolved
            ),
            interval=None if found.interval is None else _wider(found.interval, more),
            variance_of_sum=of_sum,
        )


def _with(model: Model, found: Alignment) -> Model:
    none = np.zeros((0, found.matrix.nnz), np.float32)
    record = {**model.record, "method": "fitted"}
    return replace(model, stored=found.matrix, variance=np.zeros(found.matrix.nnz), batches=none, record=record)


def _wider(interval: Interval, more: float) -> Interval:
    """With one more error, of a mean square of `more`, which may be next to nothing or several times as large."""
    mean = interval.mse + more
    return Interval(mean, interval.low, interval.high * mean / interval.mse)
