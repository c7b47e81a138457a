"""What a rendering's own variance may be: a tenth of what the sensor adds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.recording import expected_recording
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

Vector = NDArray[np.float64]
Allowed = Callable[[Vector], Vector]

SHARE = 0.1  # of the sensor's variance


def check_noise_target(scene: Scene) -> None:
    """Raise InputError where a sensor adds nothing that a rendering could be compared with."""
    noise = scene.noise
    silent = noise is None or noise.variance + noise.quantisation_variance == 0
    if scene.sensor is None and silent:
        raise InputError(
            "render.samples 'auto' renders until its own variance is a tenth of the sensor's, and this scene's sensor"
            " adds none; set noise.variance above 0, add a [sensor], or give render.samples a number"
        )


def allowed_variance(setup: Setup) -> Allowed:
    """From the light on all pixels, (M,), what the variance of its rendering may be, (M,); NaN where it is nothing.

    Raises InputError where there is no noise.
    """
    scene, camera = setup.scene, setup.camera
    check_noise_target(scene)
    sensor = scene.sensor
    if sensor is None:
        noise = scene.noise
        known = 0.0 if noise is None else noise.variance + noise.quantisation_variance
        return lambda light: np.full(light.shape, SHARE * known)
    from .sensor.response import response

    freed = response(setup)

    def of_sensor(light: Vector) -> Vector:
        values = np.maximum(np.nan_to_num(light), 0.0)
        return SHARE * expected_recording(sensor, camera, freed, values).noise_variance(values)

    return of_sensor
