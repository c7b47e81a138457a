"""What theory promises of a scene before anything is rendered: its error (Eq. 5), its sharpness, its light."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.frame_prediction import predict_frame
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.prediction import Prediction, predict
from ommatid.reconstruct.prior import prior_of
from ommatid.runtime.errors import InputError
from ommatid.runtime.processors import one_thread
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix, ideal_model


@one_thread()
def predict_scene(scene: Scene) -> Prediction:
    """What Eq. 5 and the ideal model promise of a scene."""
    setup = Setup.from_scene(scene)
    camera = setup.camera
    choice = choose_method(scene, camera, exact=camera.has_box_footprints)
    actual, shape = expected_noise(setup), camera.shape
    if choice.method == "fit":
        raise InputError("estimator.misalignment 'fit' takes a recorded stack; take 'trust' or 'robust' to predict")
    if choice.method != "dense":
        return predict_frame(choice, ideal_model(scene, camera), actual)
    prior = prior_of(scene.prior, shape, camera.target_pitch)
    tolerated = None
    if camera.tolerance is not None and camera.has_sharp_footprints and scene.estimator.misalignment == "trust":
        from ommatid.reconstruct.misalignment.tolerance_cost import cost

        tolerated = partial(cost, camera=camera, prior=prior)
    return predict(ideal_matrix(camera), prior, actual, scene.estimator, shape, tolerated)


def expected_noise(setup: Setup) -> float | NDArray[np.float64]:
    """Variance of every measurement, one number or an array: with a [sensor] that of light of the prior's mean."""
    scene = setup.scene
    if scene.sensor is not None:
        from ommatid.scenes.optics.radiometry import predicted_noise
        from ommatid.simulate.sensor.response import response

        return predicted_noise(scene, setup.camera, response(setup))
    return scene.noise.variance + scene.noise.quantisation_variance if scene.noise else 0.0


def optics(camera: Camera) -> list[dict[str, Any]]:
    """What lenses that are more than pinholes do to sharpness."""
    if all(kind.optics.pinhole for kind in camera.types):
        return []
    from ommatid.simulate.lenses.sharpness import describe

    return describe(camera)


def electrons(setup: Setup) -> dict[str, Any] | None:
    """The electrons that each lens type's pixels collect, where they are counted."""
    if setup.scene.sensor is None:
        return None
    from ommatid.scenes.optics.radiometry import summary
    from ommatid.simulate.sensor.response import response

    return summary(setup.scene, setup.camera, response(setup))
