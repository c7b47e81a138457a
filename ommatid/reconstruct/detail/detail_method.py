"""Estimation of f with the exact covariance of the detail that f does not hold."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray

from ..expected_error import CorrelatedNoise, Interval, interval, squared_error
from ..methods.dense_method import DRAWS, DenseMethod, residuals
from ..methods.method import total_variance
from ..problem import Whitening
from ..verdict.residual_power import ResidualInputs, ResidualPower
from .detailed_model import CAUSE, DetailedModel, detailed
from .world_prior import averaging

NEEDS_NOISE = (
    "detail finer than f needs noise in every measurement, got some without; set noise.variance or"
    " estimator.noise_variance to a number above 0, or target.detail to 1"
)


class DetailMethod(DenseMethod):
    """Rv holds the covariance of the detail finer than f, which is common to measurements of the same place."""

    @property
    def _model(self) -> DetailedModel:
        return detailed(self.task.model)

    @cached_property
    def observation(self) -> tuple[sparse.csr_array, CorrelatedNoise]:
        """H of the measurements used, and their noise with that of detail."""
        task, model = self.task, self._model
        whole = slice(0, task.expected_noise.size)
        white = Whitening.of([(whole, _of_used(model, task.used))], task.expected_noise, NEEDS_NOISE)
        # Errors that measurements share are whitened as independent ones, but the actual noise is without them.
        return model.matrix[task.used], CorrelatedNoise(white, CAUSE, task.shared_variance)

    def _noise_given(self, truth: FloatArray, noise: dict[str, FloatArray]) -> FloatArray:
        """Return the noise, (measurements used,), with what the uncertainty of H adds for a world of known detail."""
        if "calibration" in noise:
            noise = noise | {"calibration": self._model.fine.variance_from_model(truth)[self.task.used]}
        return total_variance(noise)

    def residual_power(
        self, truth: FloatArray | None, noise: dict[str, FloatArray], leverage: FloatArray | None
    ) -> ResidualPower | None:
        """Return the expected squares of the whitened residual; where its world is known, its detail is no noise."""
        model, form = self._model, self.estimate.form
        if truth is None or truth.size == form.problem.unknowns:
            return super().residual_power(truth, noise, leverage)
        inputs = ResidualInputs(
            observe=lambda world: self.white(model.fine.forward(world)[self.task.used]),
            draw_image=lambda _: np.zeros(truth.size),
            actual=self._noise_given(truth, noise),
            deviation=truth - model.prior_mean,
            draws=DRAWS,
            leverage=leverage,
            whiten=self.white,
        )
        return inputs.power(residuals(form, inputs.block()), form.problem.noise_variance)

    def interval(self, truth: FloatArray, noise: dict[str, FloatArray]) -> Interval:
        """Return the expected error of one image; where its world is known, its detail is no noise."""
        model, form, white = self._model, self.estimate.form, self.observation[1].white
        if truth.size == form.problem.unknowns:
            return super().interval(truth, noise)
        deviation = truth - model.prior_mean
        light = (model.fine.forward(deviation))[self.task.used]
        bias: FloatArray = averaging(self.task.shape, model.camera.detail) @ deviation - form.gain(self.white(light))
        pixels, given = np.arange(bias.size), self._noise_given(truth, noise)
        mean, variance = squared_error(form, bias[:, None], given, pixels, white)
        return interval(float(mean[0]), float(variance[0]), bias.size)


def _of_used(model: DetailedModel, used: BoolArray) -> FloatArray:
    covariance = model.detail_covariance
    if covariance is None:
        return np.diag(model.detail_variance[used])
    return np.array(covariance) if used.all() else covariance[np.ix_(used, used)]
