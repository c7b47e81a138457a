"""Estimation of f with the exact covariance of the detail that f does not hold."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import linalg

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError

from ..estimator.estimate import Estimate, estimate
from ..expected_error import Interval, expected_given, interval, solved_columns, variance_of_sum
from ..methods.dense_method import DRAWS, operators_of, residual_power, residuals
from ..methods.method import Method, MethodResult, PosteriorOperators, total_variance
from ..misalignment.robust_noise import Whitening, robust_error
from ..verdict.residual_power import ResidualInputs, ResidualPower
from .detailed_model import CAUSE, DetailedModel
from .world_prior import averaging


class DetailMethod(Method):
    """Rv holds the covariance of the detail finer than f, which is common to measurements of the same place."""

    @property
    def _model(self) -> DetailedModel:
        model = self.task.model
        if not isinstance(model, DetailedModel):
            raise TypeError("expected a model of a world finer than f")
        return model

    @cached_property
    def _solved(self) -> tuple[Whitening, Estimate]:
        task, model = self.task, self._model
        covariance = _of_used(model, task.used) + np.diag(task.expected_noise)
        try:
            factor = linalg.cholesky(covariance, lower=True, check_finite=False)
        except linalg.LinAlgError:
            raise InputError(
                "detail finer than f needs noise in every measurement, got some without; set noise.variance or"
                " estimator.noise_variance to a number above 0, or target.detail to 1"
            ) from None
        white = Whitening((slice(0, factor.shape[0]),), (np.asarray(factor),))
        problem = white.problem(model.matrix[task.used], task.prior_on(task.shape))
        recorded = white.vector(task.recorded[task.used])
        return white, estimate(problem, recorded, task.settings.tolerance)

    def estimate_image(self) -> FloatArray:
        """Return f^ alone: (N,)."""
        return self._solved[1].image

    def operators(self) -> PosteriorOperators:
        """Return the operators of the estimate."""
        white, solved = self._solved
        whitened = operators_of(solved.form, lambda values: values)

        def weigh(values: FloatArray) -> FloatArray:
            return white.multipliers(white.vector(values)[:, None])[:, 0]

        return PosteriorOperators(
            lambda values: whitened.gain(white.vector(values)),
            whitened.posterior,
            weigh,
            whitened.hidden,
            white.vector,
        )

    def result_for_assumed_prior(self, noise: dict[str, FloatArray], truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error; truth : (N,), or better (pixels of the world,), whose detail is known."""
        white, solved = self._solved
        unit = np.ones(self.task.expected_noise.size)
        # Errors that measurements share are whitened as independent ones, but `noise` is without them.
        excess = None if self.task.shared_image is None else self.task.shared_variance
        expected = robust_error(solved.form, white, noise, CAUSE, excess)
        given = total_variance(noise if truth is None else self._noise_given(truth, noise))
        return MethodResult(
            solved.image,
            solved.multipliers / np.sqrt(self.task.expected_noise),  # their squares times the noise are chi-squared
            solved.solver,
            expected,
            None if truth is None else self._interval(truth, given),
            lambda weights: variance_of_sum(solved.form, weights, unit) - self._variance_in_excess(weights, excess),
            self._residual_power(truth, given, expected.leverage),
        )

    def _variance_in_excess(self, weights: FloatArray, excess: FloatArray | None) -> float:
        """Return by how much w^T f^ varies less than what was whitened says; weights : (N,)."""
        if excess is None:
            return 0.0
        operators = self.operators()
        back = operators.weigh(self.task.observe(operators.posterior(weights)))
        return float(excess @ np.square(back))

    def _noise_given(self, truth: FloatArray, noise: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the noise with the variance that the uncertainty of H adds for a world whose detail is known."""
        fine = self._model.fine
        if "calibration" not in noise or truth.size != fine.unknowns:
            return noise
        return noise | {"calibration": fine.variance_from_model(truth)[self.task.used]}

    def _residual_power(
        self, truth: FloatArray | None, actual: FloatArray, leverage: FloatArray | None
    ) -> ResidualPower | None:
        """Return the expected squares of the whitened residual; where its world is known, its detail is no noise."""
        model, (white, solved) = self._model, self._solved
        unit = np.ones(actual.size)
        if truth is None or truth.size == solved.form.problem.unknowns:
            return residual_power(solved.form, unit, leverage, truth)
        inputs = ResidualInputs(
            observe=lambda world: white.vector(model.fine.forward(world)[self.task.used]),
            draw_image=lambda _: np.zeros(truth.size),
            actual=actual,
            deviation=truth - model.prior_mean,
            draws=DRAWS,
            leverage=leverage,
            whiten=white.vector,
        )
        return inputs.power(residuals(solved.form, inputs.block()), unit)

    def _interval(self, truth: FloatArray, noise_variance: FloatArray) -> Interval:
        """Return the expected error of one image; where its world is known, its detail is no noise."""
        model, (white, solved) = self._model, self._solved
        form = solved.form
        if truth.size == form.problem.unknowns:
            return expected_given(form, truth, np.ones(noise_variance.size))
        deviation = truth - model.prior_mean
        light = (model.fine.forward(deviation))[self.task.used]
        difference = averaging(self.task.shape, model.camera.detail) @ deviation
        bias: FloatArray = difference - form.gain(white.vector(light))
        trace = squares = along = 0.0
        for _, pixels, _, negative in solved_columns(form, np.arange(form.problem.unknowns)):
            gain = white.multipliers(negative)  # -A^T of the measurements as they are recorded
            weighted = noise_variance[:, None] * gain
            trace += float(np.sum(weighted * gain))
            spread = form.gain(white.vector(weighted))
            squares += float(np.square(spread).sum())
            along -= float(bias @ (spread @ bias[pixels]))
        return interval(float(bias @ bias) + trace, 4 * along + 2 * squares, bias.size)


def _of_used(model: DetailedModel, used: BoolArray) -> FloatArray:
    covariance = model.detail_covariance
    if covariance is None:
        return np.diag(model.detail_variance[used])
    return np.array(covariance) if used.all() else covariance[np.ix_(used, used)]
