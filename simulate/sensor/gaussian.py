"""From light to recorded values: sensor noise and quantisation, in the units of the target's pixel values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera
from ommatid.scenes.tables.sensor import NoiseTable

from ..sampling.seeds import noise_generator


def quantise(values: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Round to the nearest multiple of `level`."""
    return level * np.round(values / level)


def expose(
    light: NDArray[np.float64], noise: NoiseTable, rngs: list[np.random.Generator], slices: list[slice]
) -> NDArray[np.float64]:
    """Recorded values of `light`, (M,): noise from each sub-image's own generator, quantisation, saturation."""
    recorded = light.copy()
    if noise.variance > 0:
        for place, rng in zip(slices, rngs, strict=True):
            recorded[place] += rng.normal(0.0, noise.variance**0.5, recorded[place].shape)
    if noise.bits is not None:
        recorded = quantise(recorded, noise.level)
    # Last, so that a saturated pixel is known by its value whatever the levels are.
    return recorded if noise.saturation is None else np.minimum(recorded, noise.saturation)


def generators(camera: Camera, seed: int) -> list[np.random.Generator]:
    """One generator a sub-imager, which stays the same whatever other lens types the camera has."""
    return [noise_generator(seed, sub.type.name, sub.k, sub.l) for sub in camera.sub_imagers]
