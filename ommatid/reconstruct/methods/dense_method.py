"""The estimate of all pixels at once from one dense matrix: certified, for images of up to some thousand pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial

import numpy as np

from ommatid.runtime.arrays import FloatArray

from ..estimator.estimate import Estimate, estimate
from ..expected_error import expected_error, expected_given, variance_of_sum
from ..forms.form import Form
from ..problem import Problem
from ..verdict.residual_power import ResidualInputs, ResidualPower
from .method import Method, MethodResult, PosteriorOperators, total_variance
from .prepared import SAME_NOISE

DRAWS = 32  # of images and noise for the expected residual


class DenseMethod(Method):
    """Estimation by the certified solver."""

    @cached_property
    def estimate(self) -> Estimate:
        """Image, multipliers and the form that computed them."""
        task = self.task
        arguments = task.recorded[task.used], task.settings.tolerance

        def first() -> Estimate:
            problem = Problem(task.model.matrix[task.used], task.prior_on(task.shape), task.expected_noise)
            return estimate(problem, *arguments)

        made, difference = self.shared("form", self.conditions(), first)
        return made if difference is None else estimate(made.form.problem, *arguments, before=made)

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        return self.estimate.image

    def operators(self) -> PosteriorOperators | None:
        """Return the operators of the estimate, None where a measurement has no noise."""
        form, noise = self.estimate.form, self.task.expected_noise
        return operators_of(form, lambda values: values / noise) if form.problem.noisy else None

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


def operators_of(form: Form, weigh: Callable[[FloatArray], FloatArray]) -> PosteriorOperators:
    """Return the operators of a form; weigh : Rv^-1."""

    def posterior(image: FloatArray) -> FloatArray:
        problem = form.problem
        shift = problem.prior.apply_root_transposed(image[:, None])
        solution, _ = form.solve(shift, np.zeros((problem.measurements, 1)))
        return problem.prior.apply_root(solution)[:, 0]

    return PosteriorOperators(form.gain, posterior, weigh, lambda image: image - form.gain(form.problem.matrix @ image))


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
