"""Saturated pixels as censored measurements: their reading says only that the light and its noise reached a limit.

Without them, the readings that remain just below the limit are those whose noise happened to be low, and are biased: by
0.6 standard deviations one deviation below the limit. With the limit a deviations above the expected light, noise of
standard deviation s, and the inverse Mills ratio r = phi(a) / (1 - Phi(a)), a saturated pixel contributes log(1 - Phi)
to the log likelihood, with slope r / s and curvature -i / s^2, i = r (r - a) between 0 and 1. So it acts as a
measurement of (expected light) + s r / i with variance s^2 / i, and since the log likelihood is concave, a few
repetitions find its maximum (Newton). Kept readings stay as they are (Tobin 1958).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

from .fitting.prior_fit import PriorFit
from .methods.method import total_variance
from .noise import CERTAIN, SHARED, UsablePixels, known_noise, uniform

ROUNDS = 6
UNCHANGED = 0.05  # standard deviations of its noise: change of the light expected on a saturated pixel
LEAST_INFORMATION = 0.01  # of an unsaturated pixel: a saturated one with less is left out


def censored(
    stack: Stack, model: Model, usable: UsablePixels, image: FloatArray, fit: PriorFit | None
) -> tuple[Stack, UsablePixels]:
    """Return the stack with values for saturated pixels at an estimate, (N,), and the pixels to use with it.

    usable : of the stack as recorded;  fit : of its noise, if any
    """
    light, variance = model.light(image), _variance(stack, model, image, fit)
    deviation = np.sqrt(variance)
    with np.errstate(invalid="ignore", divide="ignore"):
        below = (_limit(stack) - light) / deviation
    ratio = np.exp(-0.5 * below**2 - special.log_ndtr(-below)) / (2 * np.pi) ** 0.5
    information = np.clip(ratio * (ratio - below), 0.0, 1.0)
    taken = usable.full & (information >= LEAST_INFORMATION)
    information = np.where(taken, information, 1.0)
    values = np.where(taken, light + deviation * ratio / information, stack.values)
    added = np.where(taken, variance * (1 / information - 1), 0.0)
    return replace(stack, values=values), replace(usable, used=usable.used | taken, censoring=added)


def has_converged(before: FloatArray, after: FloatArray, stack: Stack, usable: UsablePixels) -> bool:
    """Return True if the light on saturated pixels, (M,), changed by little of the noise."""
    change, noise = np.abs(after - before)[usable.full], total_variance(known_noise(stack))[usable.full]
    return bool((change <= UNCHANGED * np.sqrt(noise)).all())


def _variance(stack: Stack, model: Model, image: FloatArray, fit: PriorFit | None) -> FloatArray:
    """Return the variance of a reading under the light of an image before it is clipped, (M,)."""
    noise = known_noise(stack)
    if stack.recording is not None:
        noise |= stack.recording.noise(model.light(image))
    if model.variance.any():
        noise["calibration"] = model.variance_from_model(image)
    shared = model.error_variance(image)
    if shared is not None:
        noise[SHARED] = shared
    if fit is not None and fit.noise_variance is not None:
        noise = {name: noise[name] for name in CERTAIN if name in noise}
        noise["noise"] = uniform(fit.noise_variance, stack.values.size)
    return total_variance(noise)


def _limit(stack: Stack) -> FloatArray | float:
    """Return the value from which on a reading is saturated, before it is rounded: (M,) or one for all."""
    recording, table = stack.recording, stack.scene.noise
    if recording is not None:
        return (recording.sensor.full - 0.5 - recording.dark) / recording.slope
    if table is None or table.saturation is None:
        return np.inf
    return table.saturation if table.bits is None else table.level * (np.ceil(table.saturation / table.level) - 0.5)
