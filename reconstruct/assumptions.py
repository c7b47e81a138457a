"""The prior and the noise that the estimator assumes, and the method prepared with them.

The assumed noise holds everything known: the sensor's, quantisation, the rendering's own variance, and the variance
that the uncertainty of H adds at a first estimate of the image. The noise of a real sensor depends on the light, so it
too is computed again at the first estimate. Dead and saturated pixels are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

from .fitting.prior_fit import PriorFit, evidence_of, fit_prior
from .frame.conjugate_gradients import NotReachedError
from .method_choice import METHODS, MethodChoice, choose_method
from .methods.method import EstimationTask, Execution, Method, total_variance
from .noise import (
    Noise,
    UsablePixels,
    check_noise_fit,
    depends_on_light,
    initial_noise,
    noise_for_image,
    uniform,
    usable_pixels,
)

Result = TypeVar("Result")

CERTAIN = ("rendering", "calibration")  # noise that stays known when the rest of it is to be fitted


@dataclass(frozen=True)
class Assumptions:
    """The prior, the noise by cause, (pixels used,) each, the fit of either, and the method that assumes them."""

    method: Method
    usable: UsablePixels
    prior: PriorTable
    noise: Noise
    fit: PriorFit | None


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
    """Return work(choice) for the chosen method, or for tiles where a frame chosen by "auto" does not converge."""
    check_noise_fit(stack)
    choice = choose_method(stack.scene, model.camera, model.is_exact)
    try:
        return work(choice)
    except NotReachedError as error:
        if stack.scene.estimator.method != "auto":
            raise
        return work(replace(choice, method="tiles", why=str(error)))


def assumptions_for(stack: Stack, model: Model, choice: MethodChoice, execution: Execution) -> Assumptions:
    """Collect prior and noise as known or fitted, estimating the image beforehand only where they depend on it."""
    usable = usable_pixels(stack, model)

    def method_with(prior: PriorTable, noise: Noise) -> Method:
        expected = _expected_noise(stack, usable, noise)
        return METHODS[choice.method](_task(stack, model, usable, prior, expected), execution)

    prior = stack.scene.prior
    if prior.kind == "fit":
        prior = prior.model_copy(update={"kind": "independent"})
    noise, method = initial_noise(stack, model, usable, prior), None
    if depends_on_light(stack, model):
        method = method_with(prior, noise)
        noise = noise_for_image(method.image, stack, model, usable, noise)
    fit = _fit(stack, model, usable, prior, noise)
    if fit is not None and model.variance.any():
        # The uncertainty of H was taken at an image that the first prior had left noisy.
        better = method_with(*_with_fit(stack, prior, noise, fit))
        noise = noise_for_image(better.image, stack, model, usable, noise)
        fit = _fit(stack, model, usable, prior, noise)
    if fit is not None:
        prior, noise = _with_fit(stack, prior, noise, fit)
    if method is None or fit is not None or stack.scene.estimator.noise_variance is None:
        method = method_with(prior, noise)
    return Assumptions(method, usable, prior, noise, fit)


def _expected_noise(stack: Stack, usable: UsablePixels, noise: Noise) -> FloatArray:
    setting = stack.scene.estimator.noise_variance
    return uniform(setting, int(usable.used.sum())) if isinstance(setting, float) else total_variance(noise)


def _task(
    stack: Stack, model: Model, usable: UsablePixels, prior: PriorTable, expected_noise: FloatArray
) -> EstimationTask:
    scene = stack.scene
    return EstimationTask(model, stack.values, usable.used, expected_noise, prior, scene.estimator, scene.tiles)


def _certain(noise: Noise) -> Noise:
    return {name: noise[name] for name in CERTAIN if name in noise}


def _fit(stack: Stack, model: Model, usable: UsablePixels, prior: PriorTable, noise: Noise) -> PriorFit | None:
    """Return prior and noise, as far as they are to be fitted, of largest evidence; None where neither is."""
    prior_known = stack.scene.prior.kind != "fit"
    noise_known = stack.scene.estimator.noise_variance != "fit"
    if not usable.used.any() or (noise_known and prior_known):
        return None
    known = _expected_noise(stack, usable, noise) if noise_known else total_variance(_certain(noise))
    task = _task(stack, model, usable, prior, known)
    return fit_prior(*evidence_of(task, prior_known=prior_known, noise_known=noise_known))


def _with_fit(stack: Stack, prior: PriorTable, noise: Noise, fit: PriorFit) -> tuple[PriorTable, Noise]:
    """Return prior and noise with the fitted values; a fitted noise replaces the noise that the scene describes."""
    if fit.variance is not None and fit.length is not None:
        length = fit.length * stack.camera.target_pitch
        update = {"kind": "exponential", "variance": fit.variance, "correlation_length": length}
        prior = prior.model_copy(update=update)
    if fit.noise_variance is not None:
        noise = {**_certain(noise), "noise": uniform(fit.noise_variance, noise["rendering"].size)}
    return prior, noise
