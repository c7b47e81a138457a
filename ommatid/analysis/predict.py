"""Predict the error (Eq. 5), the sharpness and the light of a scene from theory; nothing is rendered."""

from __future__ import annotations

from functools import partial
from typing import Any

from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.misalignment.tolerance_cost import misalignment_variance
from ommatid.reconstruct.prediction import Prediction, predict, predict_frame
from ommatid.reconstruct.prior import prior_of
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.processors import one_thread
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix, ideal_model


@one_thread()
def predict_scene(scene: Scene) -> Prediction:
    """Predict the error of a scene with the ideal H. Raises InputError where the estimator takes a recorded stack."""
    setup = Setup.from_scene(scene)
    camera = setup.camera
    choice = choose_method(scene, camera, exact=camera.has_box_footprints)
    actual = expected_noise(setup)
    if choice.method == "fit":
        raise InputError("estimator.misalignment 'fit' takes a recorded stack; take 'trust' or 'robust' to predict")
    if choice.method != "dense":
        return predict_frame(choice, ideal_model(scene, camera), actual)
    prior = prior_of(scene.prior, camera.shape, camera.target_pitch)
    added = None
    if camera.tolerance is not None and camera.has_sharp_footprints and scene.estimator.misalignment == "trust":
        added = partial(misalignment_variance, camera=camera, prior=prior)
    return predict(ideal_matrix(camera), prior, actual, scene.estimator, camera.shape, added)


def expected_noise(setup: Setup) -> float | FloatArray:
    """Return the variance of all measurements, or of each, (M,): with a [sensor] that of light of the prior's mean."""
    scene = setup.scene
    if scene.sensor is not None:
        from ommatid.scenes.optics.radiometry import predicted_noise
        from ommatid.simulate.sensor.response import response

        return predicted_noise(scene, setup.camera, response(setup))
    return scene.noise.variance + scene.noise.quantisation_variance if scene.noise else 0.0


def optics(camera: Camera) -> list[dict[str, Any]]:
    """Return the sharpness of the lens types in JSON's types; empty where all are pinholes."""
    if all(lens_type.optics.is_pinhole for lens_type in camera.types):
        return []
    from ommatid.simulate.lenses.sharpness import describe

    return describe(camera)


def electrons(setup: Setup) -> dict[str, Any] | None:
    """Return the electrons that the pixels of each lens type collect; None without a [sensor]."""
    if setup.scene.sensor is None:
        return None
    from ommatid.scenes.optics.radiometry import summary
    from ommatid.simulate.sensor.response import response

    return summary(setup.scene, setup.camera, response(setup))
