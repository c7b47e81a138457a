"""The estimate of all pixels at once from one dense matrix: exact, to stated digits, for images of some thousand."""

from __future__ import annotations

from functools import cached_property

from ..estimator.estimate import Estimate, estimate
from ..expected_error import expected_error, expected_given, variance_of_sum
from ..problem import Problem
from .method import Method, MethodResult, Vector, total


class DenseMethod(Method):
    """By one of six forms."""

    @cached_property
    def estimate(self) -> Estimate:
        """Image, multipliers and the form that gave them."""
        task = self.task
        problem = Problem(task.model.matrix[task.used], task.prior_on(task.shape), task.expected_noise)
        return estimate(problem, task.recorded[task.used], task.settings.method, task.settings.tolerance)

    def estimated(self) -> Vector:
        """f^ alone: (N,)."""
        return self.estimate.image

    def result(self, noise: dict[str, Vector], truth: Vector | None) -> MethodResult:
        """The estimate and its error where the noise is as given."""
        found, actual = self.estimate, total(noise)
        return MethodResult(
            found.image,
            found.multipliers,
            found.solver,
            expected_error(found.form, noise),
            None if truth is None else expected_given(found.form, truth, actual),
            lambda weights: variance_of_sum(found.form, weights, actual),
        )
