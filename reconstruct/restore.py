"""From a recorded stack and a model to the image, its error bars, and where its error comes from.

The noise that the estimator expects holds everything known: the sensor's, quantisation, the rendering's own variance,
and what the uncertainty of H adds at a first estimate of the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log10
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scenes.errors import InputError
from scenes.model import Model
from scenes.scene import Scene
from scenes.stack import Stack

from .accuracy import Error, Interval, compare, expected_given, trimmed
from .estimator import ExpectedError, Gain, estimate, expected_error, factorise
from .prior import Prior, independent

Vector = NDArray[np.float64]

MOST_FEIGNED = 0.1  # of what is believed of a pixel: above it the expected error is too small to be trusted
BUDGET = ("null_space", "noise", "quantisation", "rendering", "calibration")


@dataclass(frozen=True)
class Restoration:
    """An estimate, (N,), its expected error (Eq. 5), and how it compares where the truth is known.

    `feigned` is the largest share of what is believed of a pixel that the noise of H may have feigned.
    """

    estimate: Vector
    expected: ExpectedError
    trimmed_mse: float | None
    shape: tuple[int, int]
    method: str
    condition: float
    feigned: float
    seconds: float
    truth: Vector | None
    error: Error | None
    interval: Interval | None

    def budget(self) -> dict[str, float]:
        """Parts of the expected squared error by their cause; they add up to it, an absent effect brings 0."""
        parts = {"null_space": self.expected.missing, **self.expected.parts}
        return {name: parts.get(name, 0.0) for name in BUDGET}

    @property
    def digits(self) -> float:
        """Decimal digits of the estimate that the condition of the factorised matrix leaves in float64."""
        return max(0.0, -log10(np.finfo(np.float64).eps * self.condition)) if np.isfinite(self.condition) else 0.0


def refuse_strangers(stack: Stack, model: Model, names: tuple[Path | str, Path | str]) -> None:
    """Raise InputError, naming the first difference, unless a stack and a model are of one camera and target grid."""
    recorded, calibrated = stack.camera.describe(), model.camera.describe()
    for key in [*recorded, *(key for key in calibrated if key not in recorded)]:
        if recorded.get(key) != calibrated.get(key):
            raise InputError(
                f"{names[0]} and {names[1]} do not belong together: {key} is {recorded.get(key, 'absent')} in the"
                f" stack and {calibrated.get(key, 'absent')} in the model; calibrate with the stack's scene"
            )


def restore(stack: Stack, model: Model, truth: Vector | None = None) -> Restoration:
    """Reconstruct a stack with a model as the stack's scene says (Wood et al., Eq. 4 and Eq. 5).

    truth : (N,) or None;  Raises InputError if the estimator's matrix does not fit in memory or cannot be factorised.
    """
    start = perf_counter()
    scene = stack.scene
    prior = independent(scene.prior, model.unknowns)
    noise = known_noise(stack)
    if model.variance.any():
        noise["calibration"] = model.prior_spread(prior.variance)
    gain = _gain(scene, model, prior, noise)
    image = estimate(gain, stack.values, prior.mean)
    if model.variance.any():
        noise["calibration"] = model.spread(image)
        if scene.estimator.noise_variance is None:
            gain = _gain(scene, model, prior, noise)
            image = estimate(gain, stack.values, prior.mean)
    expected = expected_error(gain, prior.variance, noise)
    shape = (model.camera.rows, model.camera.columns)
    error = None if truth is None else compare(image, truth, shape)
    interval = None if truth is None else expected_given(gain, prior, truth, np.sum(list(noise.values()), axis=0))
    return Restoration(
        estimate=image,
        expected=expected,
        trimmed_mse=trimmed(expected.variance, shape),
        shape=shape,
        method=gain.method,
        condition=gain.condition,
        feigned=float((model.feigned(gain.noise_variance) * expected.variance).max()),
        seconds=perf_counter() - start,
        truth=truth,
        error=error,
        interval=interval,
    )


def known_noise(stack: Stack) -> dict[str, Vector]:
    """Variances, (M,), of what is known of the noise before anything is estimated; absent effects have no entry."""
    noise = {"rendering": stack.variance}
    described = stack.scene.noise
    if described is not None and described.variance > 0:
        noise["noise"] = np.full(stack.values.size, described.variance)
    if described is not None and described.bits is not None:
        noise["quantisation"] = np.full(stack.values.size, described.quantisation_variance)
    return noise


def _gain(scene: Scene, model: Model, prior: Prior, noise: dict[str, Vector]) -> Gain:
    told = scene.estimator.noise_variance
    expected = np.sum(list(noise.values()), axis=0) if told is None else np.full(model.measurements, told)
    return factorise(model.matrix, prior.variance, expected, scene.estimator.method)
