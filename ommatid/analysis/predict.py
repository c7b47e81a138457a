"""Predict the error (Eq. 5), the sharpness and the light of a scene from theory; no picture is rendered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.machine import one_thread
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import check_noise_target
from ommatid.simulate.validation import check_lenses, check_scene_memory

from .run_prediction import predict_run, predict_without_rays

LEFT_OUT = "a perfect H and a perfect rendering: their uncertainty is left out"
AUTO = "samples 'auto' leave rendering and calibration a few per cent of the noise, which are left out"
FIXED = "a perfect H and a perfect rendering: fixed samples add to the run's error, by up to a half in the gallery"


def predict_scene(scene: Scene, rays: bool = True, *, picture: bool = True) -> Prediction:
    """Predict the error of a scene's run, or with `rays` False that of its ideal H and a perfect rendering.

    picture : False leaves out the error of the scene's picture without rays, and with it half of the time

    Rays of a pilot say what calibration and rendering leave uncertain. They are traced unless `needs_no_rays` is true,
    or no backend traces them. Raises InputError as a run does.
    """
    setup = Setup.from_scene(scene)
    with one_thread():
        if not rays:
            return predict_without_rays(setup, (LEFT_OUT,), picture=picture)
        if needs_no_rays(setup):
            if not is_adaptive(scene):
                least = predict_without_rays(setup, (FIXED,))
                return replace(least, mse_for_picture=None, interval=None)  # which the run's error would lie beyond
            check_noise_target(scene)
            return predict_without_rays(setup, (AUTO,))
        from ommatid.simulate.calibration.pilot import reason_against

        reason = reason_against(setup)
        if reason:
            return predict_without_rays(setup, (f"{LEFT_OUT}, since {reason}",))
        check_scene_memory(setup)
        check_lenses(setup.camera)
        return predict_run(setup)


def needs_no_rays(setup: Setup) -> bool:
    """Return True if H has a closed form that is the same everywhere, and rays would say little, or need its entries.

    They say little where rendering and calibration are adaptive. H of a large frame behind blurred lenses has too many
    entries for a pilot: it took 23 GB at 119 x 119 pixels.
    """
    scene, camera = setup.scene, setup.camera
    known = setup.is_applied and setup.has_closed_form and camera.is_sliding and camera.tolerance is None
    return known and scene.world is None and (is_adaptive(scene) or not camera.has_box_footprints)


def is_adaptive(scene: Scene) -> bool:
    """Return True if rendering and calibration take as many samples as their errors need."""
    calibrated = scene.calibration.method == "ideal" or scene.calibration.samples == "auto"
    return scene.render.samples == "auto" and calibrated


def optics(camera: Camera) -> list[dict[str, Any]]:
    """Return the sharpness of the lens types in JSON's types; empty where all are pinholes."""
    if not camera.has_width:
        return []
    from ommatid.scenes.optics.sharpness import describe

    return describe(camera)


def electrons(setup: Setup) -> dict[str, Any] | None:
    """Return the electrons that the pixels of each lens type collect; None without a [sensor]."""
    if setup.scene.sensor is None:
        return None
    from ommatid.scenes.optics import radiometry

    light = radiometry.summary(setup.scene, setup.camera, radiometry.electrons(setup.scene, setup.camera))
    passed = radiometry.transmissions(setup.camera)
    return {**light, "transmitted": passed} if passed else light
