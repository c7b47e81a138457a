"""The estimate of all pixels at once from one dense matrix: certified, for images of up to some thousand pixels."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, partial

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..estimator.estimate import Estimate, estimate
from ..expected_error import expected_error, expected_given, variance_of_sum
from ..problem import Form, Problem
from ..verdict.residual import ResidualInputs, ResidualPower
from .method import SAME_NOISE, Method, MethodResult, PosteriorOperators, total_variance

DRAWS = 32  # of images and noise for the expected residual


class DenseMethod(Method):
    """Estimation by the certified solver."""

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """H of the measurements used: (measurements used, N)."""
        return self.task.model.matrix[self.task.used]

    @property
    def problem(self) -> Problem:
        """The problem of the measurements used."""
        return Problem(self.matrix, self.task.prior_on(self.task.shape), self.task.expected_noise)

    @cached_property
    def estimate(self) -> Estimate:
        """Image, multipliers and the form that computed them."""
        arguments = self.task.recorded[self.task.used], self.task.settings.tolerance
        made, difference = self.shared("form", self.conditions(), lambda: estimate(self.problem, *arguments))
        return made if difference is None else estimate(made.form.problem, *arguments, before=made)

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        return self.estimate.image

    def observe(self, image: FloatArray) -> FloatArray:
        """Return H f by the H of the estimate: (N,) to (measurements used,), or with columns."""
        return self.matrix @ image

    def operators(self) -> PosteriorOperators | None:
        """Return the operators of the estimate, None where a measurement has no noise."""
        form, noise = self.estimate.form, self.task.expected_noise
        problem = form.problem

        def posterior(image: FloatArray) -> FloatArray:
            shift = problem.prior.apply_root_transposed(image[:, None])
            solution, _ = form.solve(shift, np.zeros((problem.measurements, 1)))
            return problem.prior.apply_root(solution)[:, 0]

        if not problem.noisy:
            return None
        return PosteriorOperators(
            gain=form.gain,
            posterior=posterior,
            weigh=lambda values: (values.T / noise).T,
            hidden=lambda image: image - form.gain(problem.matrix @ image),
        )

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual noise."""
        solution, actual = self.estimate, total_variance(noise)
        make = partial(expected_error, solution.form, noise)
        expected, difference = self.shared("errors", self.conditions(noise), make, SAME_NOISE)
        solver = solution.solver
        if difference:
            solver = solver.model_copy(update={"variance_bound": solver.variance_bound + difference})
        return MethodResult(
            solution.image,
            solution.multipliers,
            solver,
            expected,
            None if truth is None else expected_given(solution.form, truth, actual),
            lambda weights: variance_of_sum(solution.form, weights, actual),
            residual_power(solution.form, actual, expected.leverage, truth),
            difference,
        )


def residual_power(
    form: Form, actual: FloatArray, leverage: FloatArray | None, truth: FloatArray | None
) -> ResidualPower | None:
    """Return the expected squares of the residual; None where a measurement has no expected noise, or none is left.

    leverage : (M,) the diagonal of H A, which holds for the expected noise;  truth : (N,) the image, if it is known
    """
    problem = form.problem
    if not problem.noisy or not problem.measurements:
        return None
    prior = problem.prior
    inputs = ResidualInputs(
        observe=lambda image: problem.matrix @ image,
        draw_image=lambda rng: prior.apply_root(rng.normal(size=prior.dimension)),
        actual=actual,
        deviation=None if truth is None else truth - prior.mean,
        draws=DRAWS,
        leverage=leverage if np.allclose(actual, problem.noise_variance, rtol=1e-9) else None,
    )
    return inputs.power(residuals(form, inputs.block()), problem.noise_variance)


def residuals(form: Form, block: FloatArray) -> Iterator[FloatArray]:
    """Yield (I - H A) x of every column x: Rv times the multipliers."""
    if not block.size:
        return
    _, multipliers = form.solve(np.zeros((form.problem.prior.dimension, block.shape[1])), block)
    yield from (form.problem.noise_variance[:, None] * multipliers).T
