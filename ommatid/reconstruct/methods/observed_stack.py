"""A stack with the prior that is assumed of f: its noise before and after an estimate, and the estimation task."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

from ..detail.detailed_model import CAUSE as DETAIL
from ..detail.detailed_model import DetailedModel, independent_detail, model_of_f
from ..noise import SATURATION, Noise, UsablePixels, initial_noise, noise_for_image, uniform
from .method import EstimationTask, total_variance


@dataclass(frozen=True)
class ObservedStack:
    """A stack with the prior of f, and the model that this prior makes of H where the world is finer than f."""

    stack: Stack
    model: Model
    usable: UsablePixels
    prior: PriorTable

    def with_prior(self, prior: PriorTable, model: Model) -> ObservedStack:
        """Return the same stack under another prior; model : as calibrated."""
        return replace(self, prior=prior, model=model_of_f(model, self.stack.camera, prior))

    def initial_noise(self) -> Noise:
        """Return the noise before there is an estimate."""
        return self.with_detail(initial_noise(self.stack, self.model, self.usable, self.prior))

    def noise_for(self, image: FloatArray, noise: Noise) -> Noise:
        """Return the noise with the parts that depend on the light for an estimate, (N,)."""
        return self.with_detail(noise_for_image(image, self.stack, self.model, self.usable, noise))

    def with_detail(self, noise: Noise) -> Noise:
        """Add the variance of detail finer than f, unless the method knows its covariance."""
        known = {name: values for name, values in noise.items() if name != DETAIL}
        return known | independent_detail(self.model, self.usable.used)

    @property
    def detail_variance(self) -> FloatArray | float:
        """Variance of detail on the pixels used, (pixels used,)."""
        return self.model.detail_variance[self.usable.used] if isinstance(self.model, DetailedModel) else 0.0

    def expected_noise(self, noise: Noise) -> FloatArray:
        """Return the variance that the estimator assumes, (pixels used,)."""
        setting = self.stack.scene.estimator.noise_variance
        if not isinstance(setting, float):
            return total_variance(noise)
        return uniform(setting, int(self.usable.used.sum())) + noise.get(SATURATION, 0.0)

    @property
    def expects_fixed_noise(self) -> bool:
        """True if the scene fixes the expected noise to a number."""
        return isinstance(self.stack.scene.estimator.noise_variance, float)

    def task(self, expected_noise: FloatArray, shared_image: FloatArray | None = None) -> EstimationTask:
        """Return the task of an estimation method; the offset of detail's mean is taken off the measurements.

        shared_image : (N,) whose errors by few numbers of H are part of the expected noise; None: they are not
        """
        scene, model, recorded = self.stack.scene, self.model, self.stack.values
        if isinstance(model, DetailedModel):
            recorded = recorded - model.offset
        return EstimationTask(
            model,
            recorded,
            self.usable.used,
            expected_noise,
            self.prior,
            scene.estimator,
            scene.tiles,
            scene.prior_ratio,
            shared_image,
        )
