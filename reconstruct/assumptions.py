"""What the estimator is told in the end - of the image beforehand, of the noise - and the way that it goes with it.

The noise that it expects holds everything known: the sensor's, quantisation, the rendering's own variance, and what the
uncertainty of H adds at a first estimate of the image. What a real sensor adds depends on the light, so it too is taken
anew at the first estimate. Dead and saturated pixels are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables import estimation

from .fitting.prior_fit import PriorFit, evidence, fit_prior
from .frame.conjugate_gradients import NotReachedError
from .method_choice import WAYS, MethodChoice, choose_method
from .methods.method import EstimationTask, Execution, Method, total_variance
from .noise import (
    UsablePixels,
    check_noise_fit,
    depends_on_light,
    everywhere,
    noise_at_first,
    noise_given,
    usable_pixels,
)

Vector = NDArray[np.float64]
Found = TypeVar("Found")

KEPT = ("rendering", "calibration")  # noise that stays known when the rest of it is to be found


@dataclass(frozen=True)
class Assumptions:
    """What the estimator is told in the end, and the way that it goes with it."""

    method: Method
    usable: UsablePixels
    prior: estimation.PriorTable
    noise: dict[str, Vector]
    fit: PriorFit | None


def method_for(stack: Stack, model: Model) -> Method:
    """The way that `restore` goes, its estimate found, but not its error bars, which take most of the time.

    Raises InputError as `restore` does.
    """

    def gone(choice: MethodChoice) -> Method:
        way = assumptions_for(stack, model, choice, Execution()).method
        _ = way.image  # only now it shows whether this way reaches what was asked
        return way

    return with_fallback(stack, model, gone)


def with_fallback(stack: Stack, model: Model, work: Callable[[MethodChoice], Found]) -> Found:
    """Work done in the way that is chosen; by tiles where a frame that nobody asked for does not get there."""
    check_noise_fit(stack)
    choice = choose_method(stack.scene, model.camera, model.is_exact)
    try:
        return work(choice)
    except NotReachedError as error:
        if stack.scene.estimator.method != "auto":
            raise
        return work(replace(choice, method="tiles", why=str(error)))


def assumptions_for(stack: Stack, model: Model, choice: MethodChoice, hands: Execution) -> Assumptions:
    """Everything known, found or told of a stack; the way is not gone yet."""
    usable = usable_pixels(stack, model)
    prior, told = _first_prior(stack), stack.scene.estimator.noise_variance
    noise, way = noise_at_first(stack, model, usable, prior), None
    if depends_on_light(stack, model):
        way = _way(choice, stack, model, usable, prior, noise, hands)
        noise = noise_given(way.image, stack, model, usable, noise)
    found = _fitted(stack, model, usable, prior, noise)
    if found is not None and model.variance.any():
        # What the uncertainty of H adds was taken at an image that the first prior had left noisy.
        told_prior, told_noise = _with_fit(stack, prior, noise, found)
        better = _way(choice, stack, model, usable, told_prior, told_noise, hands)
        noise = noise_given(better.image, stack, model, usable, noise)
        found = _fitted(stack, model, usable, prior, noise)
    if found is not None:
        prior, noise = _with_fit(stack, prior, noise, found)
    if way is None or found is not None or told is None:
        way = _way(choice, stack, model, usable, prior, noise, hands)
    return Assumptions(way, usable, prior, noise, found)


def _first_prior(stack: Stack) -> estimation.PriorTable:
    """What is told of the prior; where that is to be found, the paper's."""
    described = stack.scene.prior
    return described.model_copy(update={"kind": "independent"}) if described.kind == "fit" else described


def _expected_noise(stack: Stack, usable: UsablePixels, noise: dict[str, Vector]) -> Vector:
    told = stack.scene.estimator.noise_variance
    return everywhere(told, int(usable.used.sum())) if isinstance(told, float) else total_variance(noise)


def _way(
    choice: MethodChoice,
    stack: Stack,
    model: Model,
    usable: UsablePixels,
    prior: estimation.PriorTable,
    noise: dict[str, Vector],
    hands: Execution,
) -> Method:
    told = stack.scene
    believed = _expected_noise(stack, usable, noise)
    task = EstimationTask(model, stack.values, usable.used, believed, prior, told.estimator, told.tiles)
    return WAYS[choice.method](task, hands)


def _fitted(
    stack: Stack, model: Model, usable: UsablePixels, prior: estimation.PriorTable, noise: dict[str, Vector]
) -> PriorFit | None:
    """The prior, and the noise if that is asked for, of largest marginal likelihood; None where nothing is asked."""
    described = stack.scene.prior
    asked = stack.scene.estimator.noise_variance == "fit"
    if not usable.used.any() or not (asked or described.kind == "fit"):
        return None
    kept = {name: noise[name] for name in KEPT if name in noise}
    known = total_variance(kept) if asked else _expected_noise(stack, usable, noise)
    task = EstimationTask(model, stack.values, usable.used, known, prior, stack.scene.estimator, stack.scene.tiles)
    return fit_prior(*evidence(task, prior_known=described.kind != "fit", noise_known=not asked))


def _with_fit(
    stack: Stack, prior: estimation.PriorTable, noise: dict[str, Vector], found: PriorFit
) -> tuple[estimation.PriorTable, dict[str, Vector]]:
    """The prior and the noise once they are found; what was found stands for the noise that the scene describes."""
    if found.variance is not None and found.length is not None:
        length = found.length * stack.camera.target_pitch
        update = {"kind": "exponential", "variance": found.variance, "correlation_length": length}
        prior = prior.model_copy(update=update)
    if found.noise_variance is not None:
        kept = {name: noise[name] for name in KEPT if name in noise}
        noise = {**kept, "noise": everywhere(found.noise_variance, noise["rendering"].size)}
    return prior, noise
