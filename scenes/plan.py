"""What a scene does not need, why, and what that changes: nothing here is computed, sampled or allocated for it."""

from __future__ import annotations

from .camera import Camera
from .needs import LeftOut, needed, without_shot_noise
from .scene import Scene


def left_out(scene: Scene, camera: Camera) -> tuple[LeftOut, ...]:
    """Of rendering, recording, calibrating and reconstructing, from the scene alone."""
    return (*_of_light(scene, camera), *_of_sensor(scene, camera), *_of_estimate(scene))


def _of_light(scene: Scene, camera: Camera) -> list[LeftOut]:
    left: list[LeftOut] = []
    if all(kind.glass.aperture is None and kind.glass.surfaces is None for kind in camera.types):
        left.append(LeftOut("samples of an aperture", "every lens is a pinhole in focus"))
    elif camera.wavelength is None:
        left.append(LeftOut("diffraction", "the scene has no camera.wavelength: light goes in rays"))
    if scene.world is None:
        why = "the target shines and nothing else is there: paths have one segment"
        left.append(LeftOut("light that bounces", why))
    return left + list(needed(scene, camera)[1])


def _of_sensor(scene: Scene, camera: Camera) -> list[LeftOut]:
    if scene.sensor is not None:
        shot = without_shot_noise(scene, camera)
        return [] if shot is None else [shot, LeftOut("second estimate for the light that makes noise", shot.why)]
    if scene.noise is None:
        return [LeftOut("sensor noise and quantisation", "the scene has no [noise] and no [sensor]")]
    left: list[LeftOut] = []
    if scene.noise.variance == 0:
        left.append(LeftOut("sensor noise", "noise.variance is 0"))
    if scene.noise.bits is None:
        left.append(LeftOut("quantisation", "the scene has no noise.bits"))
    return left


def _of_estimate(scene: Scene) -> list[LeftOut]:
    left: list[LeftOut] = []
    if scene.prior.kind == "independent":
        left.append(LeftOut("covariances between pixels of the prior", "prior.kind is 'independent'"))
    if scene.calibration.method == "ideal":
        left.append(LeftOut("point sources", "calibration.method is 'ideal', H comes in closed form"))
        left.append(LeftOut("second estimate for the uncertainty of H", "the ideal H has none"))
    elif scene.prior.kind != "fit" and scene.estimator.noise_variance not in (None, "fit"):
        why = "estimator.noise_variance says what to expect"
        left.append(LeftOut("second estimate for the uncertainty of H", why))
    return left
