"""The common level of the image, where the prior does not know it: one unknown more, which all pixels share.

Pixels that the measurements hardly see take the prior's mean, all of them with the same error: a dark picture, or the
mean of a region, would be far off by more than Eq. 5 says of independent pixels. So f = f0 + l 1 + d, with l of
variance L^2 beside the images d of the prior. A constant image is a wave of the prior, P0 1 = s 1, and with
h = C P0^-1 1 = (I - A H) 1, what the estimate lacks of it,

    v = 1 / (1^T (1 - h) / s + 1 / L^2),   l^ = v 1^T A (g - H f0) / s,   f^ = f0 + A (g - H f0) + l^ h,

which adds v h h^T to Eq. 5 (Rasmussen and Williams 2006, Eq. 2.41 and 2.42, where H^T (H P0 H^T + Rv)^-1 is P0^-1 A).
For a noise Rvm and images of c P0, others than the estimator expects, and a = v Rv^-1 H h, q = A (Rvm - c Rv) a,

    v is v + a^T (Rvm - c Rv) a + (c - 1) (v - v^2 / L^2),   and Eq. 5 gains q h^T + h q^T.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ommatid.runtime.arrays import FloatArray

if TYPE_CHECKING:
    from .method import EstimationTask, MethodResult, PosteriorOperators


@dataclass(frozen=True)
class Level:
    """The estimate of the level, and what it changes.

    value : l^, grey levels above the prior's mean;  variance : v;  known : L^2, the prior's
    response : h, (unknowns,)
    """

    value: float
    variance: float
    known: float
    response: FloatArray

    @classmethod
    def of(cls, task: EstimationTask, estimate: FloatArray, response: FloatArray) -> Level:
        """Return the level for an estimate by the prior's mean, (unknowns,), and h."""
        wave = float(np.ravel(1 / np.asarray(task.precision_on(task.shape)))[0])
        known = task.prior.level_deviation**2
        variance = 1 / (max(float(np.sum(1 - response)), 0.0) / wave + 1 / known)
        return cls(variance * float(np.sum(estimate - task.prior.mean)) / wave, variance, known, response)

    def added_to(
        self, result: MethodResult, task: EstimationTask, actual: FloatArray, operators: PosteriorOperators
    ) -> MethodResult:
        """Return the result for the prior's mean with the level; actual : (measurements used,) Rvm."""
        read, response, ratio = task.observe(self.response), task.of_f(self.response), task.prior_ratio
        gain = self.variance * operators.weigh(read)  # a
        other = (actual - ratio * task.expected_noise) * gain
        variance = self.variance + float(gain @ other) + (ratio - 1) * (self.variance - self.variance**2 / self.known)
        changed = np.abs(other).max(initial=0.0) > 0
        beside = task.of_f(operators.gain(other)) if changed else np.zeros(response.size)  # q
        expected, before = result.expected, result.variance_of_sum
        more = np.maximum(variance * response**2 + 2 * beside * response, -expected.variance)

        def variance_of_sum(weights: FloatArray) -> float:
            along = float(weights @ response)
            return before(weights) + variance * along**2 + 2 * along * float(weights @ beside)

        if operators.whiten is None:
            multipliers = operators.weigh(read)
        else:
            multipliers = operators.whiten(read) / np.sqrt(task.expected_noise)
        return replace(
            result,
            image=result.image + self.value * response,
            multipliers=result.multipliers - self.value * multipliers,
            expected=replace(
                expected, variance=expected.variance + more, missing=expected.missing + float(more.mean())
            ),
            variance_of_sum=variance_of_sum,
        )
