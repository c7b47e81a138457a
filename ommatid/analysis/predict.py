"""Predict the error (Eq. 5), the sharpness and the light of a scene from theory; no picture is rendered."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from ommatid.reconstruct.coarse_model import model_of_f
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.misalignment.moments import misalignment_variance
from ommatid.reconstruct.prediction import Prediction, predict, predict_frame
from ommatid.reconstruct.prior import prior_of
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.negligible import assumptions
from ommatid.scenes.scene import Scene, with_tables
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from ommatid.simulate.validation import check_lenses, check_scene_memory

from .calibration_goal import expected_noise
from .predicted_recording import prior_without_stack
from .run_prediction import predict_run

LEFT_OUT = "a perfect H and a perfect rendering: their uncertainty is left out"
PRIOR_LIGHT = "light of the prior's mean, and no pixel saturated"


def predict_scene(scene: Scene, rays: bool = True) -> Prediction:
    """Predict the error of a scene's run, or with `rays` False of its ideal H alone, in closed form.

    Rays of a pilot tell what calibration and rendering leave uncertain. Without a backend that traces them the
    prediction is the closed form. Raises InputError as a run does, and of the closed form where the estimator takes a
    recorded stack.
    """
    if not rays:
        return predict_ideal(scene)
    from ommatid.simulate.calibration.pilot import reason_against

    setup = Setup.from_scene(scene)
    reason = reason_against(setup)
    if reason:
        closed = predict_ideal(scene)
        return replace(closed, assumes=(f"{closed.assumes[0]}, since {reason}", *closed.assumes[1:]))
    check_scene_memory(setup)
    check_lenses(setup.camera)
    with one_thread():
        return predict_run(setup)


@one_thread()
def predict_ideal(scene: Scene) -> Prediction:
    """Predict the error of a scene with the ideal H. Raises InputError where the estimator takes a recorded stack."""
    setup = Setup.from_scene(scene)
    camera, (assumed, fitted) = setup.camera, prior_without_stack(setup)
    scene = with_tables(scene, prior=assumed)
    assumes = *_ideal_assumptions(setup), *fitted
    choice = choose_method(scene, camera, exact=camera.is_applied)
    actual = expected_noise(setup)
    if choice.method == "fit":
        raise InputError("estimator.misalignment 'fit' takes a recorded stack; take 'trust' to predict")
    if choice.method != "dense" or camera.has_detail:
        model = model_of_f(ideal_model(scene, camera.with_grid_of_matrix), camera, scene.prior)
        return replace(predict_frame(choice, model, camera, actual), assumes=assumes)
    prior = prior_of(scene.assumed_prior, camera.shape, camera.target_pitch, camera.detail)
    added = None
    if camera.tolerance is not None and camera.has_sharp_footprints and scene.estimator.misalignment == "trust":
        added = partial(misalignment_variance, camera=camera, prior=prior.scaled(scene.prior_ratio))
    matrix = ideal_matrix(camera)
    prediction = predict(
        matrix, prior, actual, scene.estimator, camera.shape, added, scene.prior_ratio, scene.prior.level_deviation
    )
    return replace(prediction, assumes=assumes)


def _ideal_assumptions(setup: Setup) -> tuple[str, ...]:
    return (LEFT_OUT, PRIOR_LIGHT, *assumptions(setup.scene, setup.camera))


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
    from ommatid.simulate.sensors import response

    light = summary(setup.scene, setup.camera, response(setup))
    if all(lens_type.optics.surfaces is None for lens_type in setup.camera.types):
        return light
    from ommatid.simulate.lenses.etendue import transmissions

    return {**light, "transmitted": transmissions(setup.camera)}
