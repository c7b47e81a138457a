"""The noise of a scene's sensor before anything is recorded."""

from __future__ import annotations

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.setup import Setup


def expected_noise(setup: Setup) -> float | FloatArray:
    """Return the variance of all measurements, or of each, (M,): with a [sensor] that of light of the prior's mean."""
    scene = setup.scene
    if scene.sensor is not None:
        from ommatid.scenes.optics.radiometry import predicted_noise
        from ommatid.simulate.sensors import response

        return predicted_noise(scene, setup.camera, response(setup))
    return scene.noise.variance + scene.noise.quantisation_variance if scene.noise else 0.0
