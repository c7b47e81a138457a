"""The estimate of all pixels at once from one dense matrix: certified, for images of up to some thousand pixels."""

from __future__ import annotations

from functools import cached_property

from ommatid.runtime.arrays import FloatArray

from ..estimator.estimate import Estimate, estimate
from ..expected_error import expected_error, expected_given, variance_of_sum
from ..problem import Problem
from .method import Method, MethodResult, total_variance


class DenseMethod(Method):
    """Estimation by one of the six dense forms."""

    @cached_property
    def estimate(self) -> Estimate:
        """Image, multipliers and the form that computed them."""
        task = self.task
        problem = Problem(task.model.matrix[task.used], task.prior_on(task.shape), task.expected_noise)
        return estimate(problem, task.recorded[task.used], task.settings.method, task.settings.tolerance)

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        return self.estimate.image

    def result(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual noise."""
        solution, actual = self.estimate, total_variance(noise)
        return MethodResult(
            solution.image,
            solution.multipliers,
            solution.solver,
            expected_error(solution.form, noise),
            None if truth is None else expected_given(solution.form, truth, actual),
            lambda weights: variance_of_sum(solution.form, weights, actual),
        )
