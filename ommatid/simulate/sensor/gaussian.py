"""The ideal sensor: normal noise, quantisation and saturation, in the units of the target's pixel values."""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.tables.sensor import NoiseTable

from ..sampling.seeds import noise_generator


def quantise(values: FloatArray, level: float) -> FloatArray:
    """Round to the nearest multiple of `level`."""
    return level * np.round(values / level)


def expose(light: FloatArray, noise: NoiseTable, rngs: list[np.random.Generator], slices: list[slice]) -> FloatArray:
    """Return the recorded values of `light`, (M,): noise from each sub-image's generator, quantised, saturated."""
    recorded = light.copy()
    if noise.variance > 0:
        for measurements, rng in zip(slices, rngs, strict=True):
            recorded[measurements] += rng.normal(0.0, noise.variance**0.5, recorded[measurements].shape)
    if noise.bits is not None:
        recorded = quantise(recorded, noise.level)
    # Last, so that a saturated pixel is recognised by its value whatever the levels are.
    return recorded if noise.saturation is None else np.minimum(recorded, noise.saturation)


def generators(camera: Camera, seed: int) -> list[np.random.Generator]:
    """Return one generator per sub-imager, independent of the other lens types of the camera."""
    return [noise_generator(seed, sub.type.name, sub.k, sub.l) for sub in camera.sub_imagers]
