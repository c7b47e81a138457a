"""Target for the variance of a rendering: a tenth of the sensor's own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.recording import expected_recording_of, flat_values
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

AllowedVariance = Callable[[FloatArray, slice], FloatArray]  # of light on some measurements, and their slice
SHARE = 0.1  # of the sensor's variance


def check_noise_target(scene: Scene) -> None:
    """Raise InputError if the sensor adds no noise that a rendering could be compared with."""
    noise = scene.noise
    silent = noise is None or noise.variance + noise.quantisation_variance == 0
    if scene.sensor is None and silent:
        raise InputError(
            "render.samples 'auto' renders until its own variance is a tenth of the sensor's, and this scene's sensor"
            " adds none; set noise.variance above 0, add a [sensor], or give render.samples a number"
        )


def allowed_variance(setup: Setup) -> AllowedVariance:
    """Return the function from light on some measurements, and their slice, to the allowed variance of its rendering.

    NaN where a pixel receives no light. Raises InputError if the sensor adds no noise.
    """
    check_noise_target(setup.scene)
    sensor, noise = setup.scene.sensor, setup.scene.noise
    if sensor is None:
        known = 0.0 if noise is None else noise.variance + noise.quantisation_variance
        return lambda light, _: np.full(light.shape, SHARE * known)
    from .sensor.response import response

    electrons = response(setup)
    level = flat_values(sensor, setup.camera, electrons)

    def of_sensor(light: FloatArray, rows: slice) -> FloatArray:
        values = np.maximum(np.nan_to_num(light), 0.0)
        expected = expected_recording_of(sensor, level[rows], electrons[rows], values)
        return SHARE * expected.noise_variance(values)

    return of_sensor
