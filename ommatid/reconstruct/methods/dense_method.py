"""The estimate of all pixels at once from one dense matrix: certified, for images of up to some thousand pixels."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, partial

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..estimator.estimate import Estimate, estimate
from ..expected_error import CorrelatedNoise, Interval, expected_error, expected_given, variance_of_sum
from ..problem import Form, Problem
from ..verdict.residual import ResidualInputs, ResidualPower
from .method import SAME_NOISE, Method, MethodResult, PosteriorOperators, total_variance

DRAWS = 32  # of images and noise for the expected residual


class DenseMethod(Method):
    """Estimation by the certified solver."""

    @cached_property
    def observation(self) -> tuple[sparse.csr_array, CorrelatedNoise | None]:
        """H of the measurements used, (measurements used, N), and their noise where it is correlated."""
        return self.task.model.matrix[self.task.used], None

    @property
    def correlated(self) -> CorrelatedNoise | None:
        """The noise of the measurements where it is correlated, None where it is independent."""
        return self.observation[1]

    @property
    def problem(self) -> Problem:
        """The problem of the measurements, whitened where their noise is correlated."""
        prior, (matrix, correlated) = self.task.prior_on(self.task.shape), self.observation
        if correlated is None:
            return Problem(matrix, prior, self.task.expected_noise)
        return correlated.white.problem(matrix, prior)

    @property
    def recorded(self) -> FloatArray:
        """The measurements of `problem`: (measurements used,)."""
        return self.white(self.task.recorded[self.task.used])

    def white(self, values: FloatArray) -> FloatArray:
        """Return values of measurements, (measurements used,) or with columns, as `problem` takes them."""
        return values if self.correlated is None else self.correlated.white.vector(values)

    def white_noise(self, noise: dict[str, FloatArray]) -> FloatArray:
        """Return the variances of actual noise as `problem` takes it: (measurements used,)."""
        return total_variance(noise) if self.correlated is None else np.ones(self.task.expected_noise.size)

    @cached_property
    def estimate(self) -> Estimate:
        """Image, multipliers and the form that computed them."""
        arguments = self.recorded, self.task.settings.tolerance
        made, difference = self.shared("form", self.conditions(), lambda: estimate(self.problem, *arguments))
        return made if difference is None else estimate(made.form.problem, *arguments, before=made)

    def estimate_image(self) -> FloatArray:
        """Compute f^ without its error: (N,)."""
        return self.estimate.image

    def observe(self, image: FloatArray) -> FloatArray:
        """Return H f by the H of the estimate: (N,) to (measurements used,), or with columns."""
        return self.observation[0] @ image

    def operators(self) -> PosteriorOperators | None:
        """Return the operators of the estimate, None where a measurement has no noise."""
        form, noise, correlated = self.estimate.form, self.task.expected_noise, self.correlated
        problem = form.problem

        def posterior(image: FloatArray) -> FloatArray:
            shift = problem.prior.apply_root_transposed(image[:, None])
            solution, _ = form.solve(shift, np.zeros((problem.measurements, 1)))
            return problem.prior.apply_root(solution)[:, 0]

        def weigh(values: FloatArray) -> FloatArray:
            return (values.T / noise).T if correlated is None else correlated.white.multipliers(self.white(values))

        if not problem.noisy:
            return None
        return PosteriorOperators(
            gain=lambda values: form.gain(self.white(values)),
            posterior=posterior,
            weigh=weigh,
            hidden=lambda image: image - form.gain(problem.matrix @ image),
            whiten=None if correlated is None else self.white,
        )

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error for the actual noise."""
        solution, correlated, variance = self.estimate, self.correlated, self.white_noise(noise)
        make = partial(expected_error, solution.form, noise, correlated=correlated)
        expected, difference = self.shared("errors", self.conditions(noise), make, SAME_NOISE)
        solver, multipliers = solution.solver, solution.multipliers
        if difference:
            solver = solver.model_copy(update={"variance_bound": solver.variance_bound + difference})
        if correlated is not None:  # their squares times the expected noise are chi-squared
            multipliers = multipliers / np.sqrt(self.task.expected_noise)
        return MethodResult(
            solution.image,
            multipliers,
            solver,
            expected,
            None if truth is None else self.interval(truth, noise),
            lambda weights: variance_of_sum(solution.form, weights, variance) - self._in_excess(weights),
            self.residual_power(truth, noise, expected.leverage),
            difference,
        )

    def interval(self, truth: FloatArray, noise: dict[str, FloatArray]) -> Interval:
        """Return the expected error of one image for the actual noise."""
        return expected_given(self.estimate.form, truth, self.white_noise(noise))

    def residual_power(
        self, truth: FloatArray | None, noise: dict[str, FloatArray], leverage: FloatArray | None
    ) -> ResidualPower | None:
        """Return the expected squares of the residual for the actual noise; leverage : (M,) the diagonal of H A."""
        return residual_power(self.estimate.form, self.white_noise(noise), leverage, truth)

    def _in_excess(self, weights: FloatArray) -> float:
        """Return by how much w^T f^ varies less than what was whitened says; weights : (N,)."""
        operators = self.operators()
        if operators is None or self.correlated is None or not self.correlated.excess.any():
            return 0.0
        back = operators.weigh(self.task.observe(operators.posterior(weights)))
        return float(self.correlated.excess @ np.square(back))


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
