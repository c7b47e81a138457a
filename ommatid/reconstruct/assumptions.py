"""The prior and the noise that the estimator assumes of a stack, and the method prepared with them.

The assumed noise holds everything known: the sensor's, quantisation, the rendering's own variance, and the variance
that the uncertainty of H adds at a first estimate of the image. The noise of a real sensor depends on the light, so it
too is computed again at the first estimate. Dead pixels are left out; saturated ones count as censored, again at the
first estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

from .coarse_model import CoarseModel, model_of_f
from .frame.conjugate_gradients import NotReachedError
from .method_choice import METHODS, MethodChoice, choose_method
from .methods.method import Execution, Method, MethodResult, total_variance
from .model_error.attenuation import can_be_corrected, with_attenuation
from .model_error.contrast import Contrast, true_contrast
from .model_error.shared_errors import NEGLIGIBLE as NEGLIGIBLE_PART
from .model_error.shared_errors import bound, with_common_rounding, with_shared_errors
from .noise import (
    ROUNDS,
    SHARED,
    Noise,
    ObservedStack,
    UsablePixels,
    censored,
    certain,
    check_noise_fit,
    common_rounding,
    depends_on_light,
    fitted_noise,
    has_converged,
    has_shared_errors,
    of_smooth_parts,
    undithered,
    usable_pixels,
)
from .prior_fit import PriorFit, fit_prior

Result = TypeVar("Result")

NEGLIGIBLE = 0.01  # share of the noise, up to which the uncertainty of H needs no second look
RENDERING = 0.03  # relative deviation of the error by rendering from that of its stated variances, of few passes, and
FEW_SAMPLES = 0.4  # over the samples of a pass: where few miss an edge, the variance is small and the weight large


def _needs_no_matrix(stack: Stack, model: Model) -> bool:
    """Return True if H is applied without being stored; methods for misalignment start from H as designed."""
    trusted = stack.scene.estimator.misalignment == "trust"
    return model.is_applied if trusted else model.is_exact


@dataclass(frozen=True)
class Assumptions:
    """The prior, the noise by cause, (pixels used,) each, the fit of either, and the method that assumes them.

    contrast : of the true image, where the uncertainty of H depends on it
    shared_image : (N,) on which errors of few numbers of H act, None where they are no part of the noise
    of_rendering : relative deviation of the error by rendering from that of its stated variances
    """

    method: Method
    usable: UsablePixels
    prior: PriorTable
    noise: Noise
    fit: PriorFit | None
    contrast: Contrast | None = None
    shared_image: FloatArray | None = None
    of_rendering: float = RENDERING

    def result(self, truth: FloatArray | None) -> MethodResult:
        """Return the estimate and its error, with what errors of H and of rounding do beyond noise where that matters.

        truth : (N,), or (pixels of the world,) for a method that takes detail into account
        """
        result, method = self._with_errors_of_h(truth), self.method
        operators = None if undithered(self.noise) is None else method.operators()
        if operators is None:
            return result
        task = method.task
        cosine, sine = common_rounding(self.noise, task.model.forward(method.image)[task.used])
        every = (task.on_all_measurements(each, 0.0) for each in (cosine, sine))
        columns = np.stack([of_smooth_parts(each, task.model.applied)[task.used] for each in every])
        actual = total_variance(self._independent_noise)
        return with_common_rounding(result, method, operators, columns, truth, actual)

    def _with_errors_of_h(self, truth: FloatArray | None) -> MethodResult:
        method, independent = self.method, self._independent_noise
        shared = has_shared_errors(method.task.model)
        operators = method.operators() if self.contrast is not None or shared else None
        if operators is None:
            # Errors that measurements share count as independent ones of the same variance.
            return self._without_attenuation(self._with_shared_as_independent, truth)
        result, actual = self._without_attenuation(independent, truth), total_variance(independent)
        if self.contrast is not None:
            known = truth if truth is not None and truth.size == method.task.model.unknowns else None
            result = with_attenuation(result, method, operators, self.contrast.image, known, actual)
        if not shared:
            return result
        image = method.image if self.shared_image is None else self.shared_image
        if SHARED not in self.noise:
            most = bound(method.task, image)
            if most <= NEGLIGIBLE_PART * result.expected.mse:
                return replace(result, left_out=most)
        return with_shared_errors(result, method, operators, image, truth, actual)

    @property
    def _independent_noise(self) -> Noise:
        return {name: values for name, values in self.noise.items() if name != SHARED}

    @property
    def _with_shared_as_independent(self) -> Noise:
        if SHARED not in self.noise:
            return self.noise
        return self._independent_noise | {"calibration": self.noise[SHARED] + self.noise.get("calibration", 0.0)}

    def _without_attenuation(self, noise: Noise, truth: FloatArray | None) -> MethodResult:
        """Return the result of the method, whose interval allows for what is not known of the rendering's variance."""
        result = self.method.result(noise, truth)
        unknown = self.of_rendering * result.expected.parts.get("rendering", 0.0)
        if result.interval is None or not unknown:
            return result
        count = result.image.size
        return replace(result, interval=result.interval.with_added(0.0, (count * unknown) ** 2, count))


def assumptions_at(
    stack: Stack, model: Model, choice: MethodChoice, image: FloatArray, execution: Execution
) -> Assumptions:
    """Collect the noise of a known image, (N,) or (pixels of the world,), and the method for a known prior.

    Use it for predictions and the goal of a calibration. A quick method is given readings of the prior's mean, of which
    there is nothing to solve.
    """
    usable, prior = usable_pixels(stack, model), stack.scene.assumed_prior
    of_image = model_of_f(model, stack.camera, prior)
    if image.size != of_image.unknowns:
        image = averaged(image.reshape(stack.camera.world.shape), stack.camera.detail).ravel()
    if usable.saturated:
        stack, usable = censored(stack, of_image, usable, image, None)
    observation = ObservedStack(stack, of_image, usable, prior)
    noise = observation.noise(image)
    if execution.quick:
        recorded = of_image.forward(np.full(of_image.unknowns, prior.mean))
        observation = replace(observation, stack=replace(stack, values=recorded))
    method = METHODS[choice.method](observation.task(observation.expected_noise(noise)), execution)
    return Assumptions(method, usable, prior, noise, None, of_rendering=_of_rendering(stack))


def method_for(stack: Stack, model: Model) -> Method:
    """Return the method that `restore` uses, with its estimate but without error bars, which take most of the time.

    Raises InputError as `restore` does.
    """

    def estimated(choice: MethodChoice) -> Method:
        method = assumptions_for(stack, model, choice, Execution()).method
        _ = method.image  # raises NotReachedError where the method misses the accuracy asked for
        return method

    return with_fallback(stack, model, estimated)


def with_fallback(stack: Stack, model: Model, work: Callable[[MethodChoice], Result]) -> Result:
    """Return work(choice) for the chosen method, or for another where a frame chosen by "auto" does not converge.

    That is one dense problem of few pixels, tiles of many. Few pixels are a dense problem at once where sensor pixels
    are dead or saturated.
    """
    check_noise_fit(stack)
    choice = choose_method(stack.scene, stack.camera, _needs_no_matrix(stack, model))
    replaceable = stack.scene.estimator.method == "auto" and not stack.camera.has_detail
    few = stack.camera.unknowns <= MOST_DENSE
    if choice.method == "frame" and replaceable and few and not usable_pixels(stack, model).used.all():
        choice = replace(choice, method="dense", why="some sensor pixels are dead or saturated")
    try:
        return work(choice)
    except NotReachedError as error:
        if not replaceable:
            raise
        return work(replace(choice, method="dense" if few else "tiles", why=str(error)))


def assumptions_for(stack: Stack, model: Model, choice: MethodChoice, execution: Execution) -> Assumptions:
    """Collect prior and noise as known or fitted, estimating the image beforehand only where they depend on it.

    Saturated pixels are left out at first, and then count as censored.
    """
    usable = usable_pixels(stack, model)
    assumed = _assumptions(stack, model, usable, choice, execution)
    if not usable.saturated:
        return assumed
    image = assumed.method.preliminary_image
    for _ in range(ROUNDS):
        of_image = assumed.method.task.model
        values, pixels = censored(stack, of_image, usable, image, assumed.fit)
        execution = replace(execution, nearby=assumed.method.nearby)
        assumed = _assumptions(values, model, pixels, choice, execution)
        before, image = of_image.forward(image), assumed.method.preliminary_image
        if has_converged(before, assumed.method.task.model.forward(image), stack, usable):
            break
    return assumed


def _assumptions(
    stack: Stack, model: Model, usable: UsablePixels, choice: MethodChoice, execution: Execution
) -> Assumptions:
    """Collect prior and noise for the pixels that are usable."""
    prior = stack.scene.assumed_prior
    if prior.kind == "fit":
        prior = prior.model_copy(update={"kind": "independent"})
    first = ObservedStack(stack, model_of_f(model, stack.camera, prior), usable, prior)

    def method_with(observation: ObservedStack, noise: Noise, image: FloatArray | None = None) -> Method:
        shared = image if SHARED in noise and not observation.expects_fixed_noise else None
        return METHODS[choice.method](observation.task(observation.expected_noise(noise), shared), execution)

    def preliminary(observation: ObservedStack, noise: Noise) -> Method:
        """Return a method for a first image, a dense one where H on f's grid has entries."""
        if isinstance(observation.model, CoarseModel) and observation.model.stored is not None:
            return METHODS["dense"](observation.task(observation.expected_noise(noise)), execution)
        return method_with(observation, noise)

    observation, noise, method, image = first, first.noise(), None, None
    if depends_on_light(stack, model) or SHARED in noise:
        method = preliminary(first, noise)
        image = method.preliminary_image
        noise = first.noise(image, shared=SHARED in noise)
    fit = _fit(first, noise)
    if fit is not None and (model.variance.any() or SHARED in noise):
        # The uncertainty of H was taken at an image that the first prior had left noisy.
        better, fitted = _with_fit(first, model, noise, fit)
        image = preliminary(better, fitted).preliminary_image
        before, noise = total_variance(noise), better.noise(image, shared=SHARED in noise)
        if float(np.abs(total_variance(noise) - before).sum()) > NEGLIGIBLE * float(before.sum()):
            fit = _fit(first, noise)
    if fit is not None:
        observation, noise = _with_fit(first, model, noise, fit)
    fixed = observation.expects_fixed_noise
    if method is None or fit is not None or not fixed:
        method = method_with(observation, noise, image)
    contrast = _true_contrast(method, noise)
    if contrast is not None:
        noise, image = noise | {"calibration": contrast.calibration(method, noise)}, contrast.image
    shared = _shared_image(method, noise, image)
    if shared is not None:
        noise = observation.with_shared(noise, shared)
    if not fixed and (contrast is not None or SHARED in noise):
        method = method_with(observation, noise, shared)
    deviation = _of_rendering(stack)
    return Assumptions(method, observation.usable, observation.prior, noise, fit, contrast, shared, deviation)


def _of_rendering(stack: Stack) -> float:
    """Return the relative deviation of the error by rendering from that of its stated variances."""
    samples, passes = (int(stack.record.get(name) or 0) for name in ("samples", "passes"))
    return max(RENDERING, FEW_SAMPLES * min(passes / samples, 1.0)) if samples else RENDERING


def _shared_image(method: Method, noise: Noise, image: FloatArray | None) -> FloatArray | None:
    """Return the image on which errors of few numbers of H act, (N,), None where they are no part of the noise.

    image : of which `noise` was taken, None where it is the same for all images
    """
    if SHARED not in noise:
        return None
    actual = total_variance(noise)
    operators = method.operators()
    if float(noise[SHARED].sum()) <= NEGLIGIBLE * float(actual.sum()) or operators is None:
        return method.image if image is None else image
    return true_contrast(method, operators, actual, attenuated=False).image


def _true_contrast(method: Method, noise: Noise) -> Contrast | None:
    """Return the contrast on which the errors of H act, None where they hardly matter or nothing can show it."""
    if "calibration" not in noise or not can_be_corrected(method):
        return None
    actual = total_variance(noise)
    if float(noise["calibration"].sum()) <= NEGLIGIBLE * float(actual.sum()):
        return None
    operators = method.operators()
    return None if operators is None else true_contrast(method, operators, actual, attenuated=True)


def _fit(observation: ObservedStack, noise: Noise) -> PriorFit | None:
    """Return prior and noise, as far as they are to be fitted, of largest evidence; None where neither is."""
    scene = observation.stack.scene
    prior_known, noise_known = scene.prior.kind != "fit", scene.estimator.noise_variance != "fit"
    if not observation.usable.used.any() or (noise_known and prior_known):
        return None
    known = observation.expected_noise(noise) if noise_known else total_variance(certain(noise))
    return fit_prior(observation.task(known), prior_known=prior_known, noise_known=noise_known)


def _with_fit(observation: ObservedStack, model: Model, noise: Noise, fit: PriorFit) -> tuple[ObservedStack, Noise]:
    """Return prior and noise with the fitted values; a fitted noise replaces the noise that the scene describes.

    model : as calibrated
    """
    if fit.prior is not None:
        observation = observation.with_prior(fit.prior, model)
    return observation, fitted_noise(noise, fit)
