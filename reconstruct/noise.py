"""What is known of a stack's noise before and after a first estimate, pixel by pixel and by its causes.

Where the sensor is a real one its noise depends on the light: it is first taken from the readings near a pixel, then,
as the uncertainty of H is, from what the first estimate says should arrive there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.model import Model
from ommatid.scenes.optics.negligible import without_shot_noise
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables import estimation

from .methods.method import is_uniform

Vector = NDArray[np.float64]
Noise = dict[str, Vector]


@dataclass(frozen=True)
class UsablePixels:
    """Which of the M sensor pixels are used, and how many are not, and why."""

    used: NDArray[np.bool_]
    dead: int
    saturated: int


def usable_pixels(stack: Stack, model: Model | None = None) -> UsablePixels:
    """Which pixels tell something: not those that are no number (dead), nor those at the level of saturation.

    Nor, where the model is given, those of which it does not know what they see.
    """
    alive = np.isfinite(stack.values) & np.isfinite(stack.variance)
    if model is not None and model.stored is not None:
        alive &= np.diff(model.stored.indptr) > 0
    noise = stack.scene.noise
    full = np.zeros_like(alive)
    if stack.recording is not None:
        full = alive & stack.recording.saturated
    elif noise is not None and noise.saturation is not None:
        full = alive & (stack.values >= np.float32(noise.saturation))  # the stack holds float32
    return UsablePixels(alive & ~full, int(np.sum(~alive)), int(np.sum(full)))


def known_noise(stack: Stack) -> Noise:
    """Variances, (M,), of what is known of the noise before anything is estimated; absent effects have no entry."""
    noise = {"rendering": stack.variance}
    if stack.recording is not None:
        return noise | stack.recording.noise(stack.recording.light_nearby(stack.camera))
    described = stack.scene.noise
    if described is not None and described.variance > 0:
        noise["noise"] = everywhere(described.variance, stack.values.size)
    if described is not None and described.bits is not None:
        noise["quantisation"] = everywhere(described.quantisation_variance, stack.values.size)
    return noise


def noise_at_first(stack: Stack, model: Model, usable: UsablePixels, prior: estimation.PriorTable) -> Noise:
    """Variances, (pixels used,), of everything that is known of the noise before there is an estimate."""
    noise = {name: of_used(variances, usable.used) for name, variances in known_noise(stack).items()}
    if model.variance.any():
        noise["calibration"] = model.prior_variance_from_model(np.full(model.unknowns, prior.variance))[usable.used]
    return noise


def depends_on_light(stack: Stack, model: Model) -> bool:
    """Whether some of the noise is only known once there is an estimate."""
    counted = stack.recording is not None and without_shot_noise(stack.scene, stack.camera) is None
    return counted or bool(model.variance.any())


def noise_given(image: Vector, stack: Stack, model: Model, usable: UsablePixels, noise: Noise) -> Noise:
    """The same noise with what depends on the light as this estimate of the image, (N,), has it."""
    noise = dict(noise)
    if stack.recording is not None:
        found = stack.recording.noise(model.forward(image))
        noise |= {name: of_used(variances, usable.used) for name, variances in found.items()}
    if model.variance.any():
        noise["calibration"] = model.variance_from_model(image)[usable.used]
    return noise


def everywhere(number: float, count: int) -> Vector:
    """One number for `count` pixels."""
    return np.broadcast_to(np.float64(number), (count,))  # stored once


def of_used(values: Vector, used: NDArray[np.bool_]) -> Vector:
    """Of all pixels' values, (M,), those of the pixels used."""
    if used.all():
        return values
    return everywhere(float(values[0]), int(used.sum())) if is_uniform(values) else values[used]


def check_noise_fit(stack: Stack) -> None:
    """Raise InputError where one number is to be found for the noise of a sensor whose every pixel has its own."""
    if stack.recording is not None and stack.scene.estimator.noise_variance == "fit":
        raise InputError(
            "estimator.noise_variance 'fit' finds one number for all pixels, but what a [sensor] adds is known, and"
            " differs from pixel to pixel with the light; remove the key"
        )
