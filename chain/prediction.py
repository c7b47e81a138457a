"""What theory promises of a scene before anything is rendered: its error (Eq. 5), its sharpness, its light."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruct.accuracy import Prediction, predict
from reconstruct.choice import choose
from reconstruct.foresight import predict_large
from reconstruct.prior import prior_of
from scenes.camera import Camera, derive
from scenes.errors import InputError
from scenes.processors import one_thread
from scenes.scene import Scene
from simulate.ideal import ideal_matrix, ideal_model


@one_thread()
def predicted(scene: Scene) -> Prediction:
    """What Eq. 5 and the ideal model promise of a scene."""
    camera = derive(scene)
    choice = choose(scene, camera, exact=camera.boxed)
    actual, shape = foreseen_noise(scene, camera), (camera.rows, camera.columns)
    if choice.way == "fit":
        raise InputError("estimator.misalignment 'fit' takes a recorded stack; take 'trust' or 'robust' to predict")
    if choice.way != "dense":
        return predict_large(choice, ideal_model(scene, camera), actual)
    prior = prior_of(scene.prior, shape, camera.target_pitch)
    tolerated = None
    if camera.tolerance is not None and camera.stays_sharp and scene.estimator.misalignment == "trust":
        from reconstruct.tolerance import cost

        tolerated = partial(cost, camera=camera, prior=prior)
    return predict(ideal_matrix(camera), prior, actual, scene.estimator, shape, tolerated)


def foreseen_noise(scene: Scene, camera: Camera) -> float | NDArray[np.float64]:
    """Variance of every measurement, one number or an array: with a [sensor] that of light of the prior's mean."""
    if scene.sensor is not None:
        from scenes.photons import predicted_noise
        from simulate.response import response

        return predicted_noise(scene, camera, response(scene, camera))
    return scene.noise.variance + scene.noise.quantisation_variance if scene.noise else 0.0


def optics(camera: Camera) -> list[dict[str, Any]]:
    """What lenses that are more than pinholes do to sharpness."""
    if all(kind.glass.pinhole for kind in camera.types):
        return []
    from simulate.lens_report import describe

    return describe(camera)


def electrons(scene: Scene, camera: Camera) -> dict[str, Any] | None:
    """The electrons that each lens type's pixels collect, where they are counted."""
    if scene.sensor is None:
        return None
    from scenes.photons import summary
    from simulate.response import response

    return summary(scene, camera, response(scene, camera))
