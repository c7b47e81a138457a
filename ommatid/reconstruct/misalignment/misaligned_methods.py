"""Methods that expect a misaligned camera: with additional noise, or with an H fitted to the stack.

Both start from H of the camera as designed, and need a dense problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..expected_error import CorrelatedNoise, Interval
from ..methods.dense_method import DenseMethod
from ..methods.method import MethodResult, Value
from ..methods.prepared import Conditions
from .alignment import Alignment, align
from .robust_noise import CAUSE, robust_noise, whitening


class RobustMethod(DenseMethod):
    """Rv holds E[dH P0 dH^T] of every sub-imager's misalignment within its tolerance."""

    @cached_property
    def observation(self) -> tuple[sparse.csr_array, CorrelatedNoise]:
        """E[H] of the measurements used, and their noise with that of misalignment."""
        task = self.task
        misaligned = robust_noise(task.model.camera, task.prior_on(task.shape))
        white = whitening(task.model.camera, misaligned, task.expected_noise, task.used)
        return misaligned.matrix[task.used], CorrelatedNoise(white, CAUSE, np.zeros(task.expected_noise.size))

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error with the given noise and misalignment as its tolerance says.

        There is no interval for a given image: misalignment acts on it otherwise than on images of the prior.
        """
        del truth
        return super().result_for_assumed_prior(noise, None)


class AlignedMethod(DenseMethod):
    """H is that of the misalignments which are most likely given the stack."""

    @cached_property
    def alignment(self) -> Alignment:
        """Fitted misalignments and their remaining uncertainty."""
        task = self.task
        prior = task.prior_on(task.shape)
        return align(task.model.camera, task.recorded[task.used], task.expected_noise, prior, task.used)

    @cached_property
    def observation(self) -> tuple[sparse.csr_array, None]:
        """H of the measurements used with the fitted misalignments."""
        return self.alignment.matrix[self.task.used], None

    def shared(
        self, name: str, conditions: Conditions, make: Callable[[], Value], tolerance: float = 0.0
    ) -> tuple[Value, float | None]:
        """Make every result anew: H is that of this stack."""
        del name, conditions, tolerance
        return make(), None

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error with the given noise; the remaining uncertainty of the fit adds to it."""
        result, alignment = super().result_for_assumed_prior(noise, truth), self.alignment
        added, expected = float(alignment.variance.mean()), result.expected

        def variance_of_sum(weights: FloatArray) -> float:
            return result.variance_of_sum(weights) + alignment.variance_of_sum(weights)

        return replace(
            result,
            expected=replace(
                expected,
                variance=expected.variance + alignment.variance,
                parts={**expected.parts, CAUSE: added},
                leverage=None,
            ),
            interval=None if result.interval is None else _wider(result.interval, added),
            variance_of_sum=variance_of_sum,
        )


def _wider(interval: Interval, added: float) -> Interval:
    """Return an interval with one more error of mean square `added`, which may be almost zero or several times that."""
    mean = interval.mse + added
    return Interval(mean, interval.low, interval.high * mean / interval.mse)
