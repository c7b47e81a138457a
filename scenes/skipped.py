"""What a scene does not need, why, and what that changes: nothing here is computed, sampled or allocated for it."""

from __future__ import annotations

from .camera import Camera
from .optics.negligible import SkippedEffect, without_negligible_effects, without_shot_noise
from .scene import Scene


def skipped_effects(scene: Scene, camera: Camera) -> tuple[SkippedEffect, ...]:
    """Of rendering, recording, calibrating and reconstructing, from the scene alone."""
    return (*_of_light(scene, camera), *_of_sensor(scene, camera), *_of_estimate(scene))


def _of_light(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    left: list[SkippedEffect] = []
    if all(kind.optics.aperture is None and kind.optics.surfaces is None for kind in camera.types):
        left.append(SkippedEffect("samples of an aperture", "every lens is a pinhole in focus"))
    elif camera.wavelength is None:
        left.append(SkippedEffect("diffraction", "the scene has no camera.wavelength: light goes in rays"))
    if scene.world is None:
        why = "the target shines and nothing else is there: paths have one segment"
        left.append(SkippedEffect("light that bounces", why))
    return left + list(without_negligible_effects(scene, camera)[1])


def _of_sensor(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    if scene.sensor is not None:
        shot = without_shot_noise(scene, camera)
        return [] if shot is None else [shot, SkippedEffect("second estimate for the light that makes noise", shot.why)]
    if scene.noise is None:
        return [SkippedEffect("sensor noise and quantisation", "the scene has no [noise] and no [sensor]")]
    left: list[SkippedEffect] = []
    if scene.noise.variance == 0:
        left.append(SkippedEffect("sensor noise", "noise.variance is 0"))
    if scene.noise.bits is None:
        left.append(SkippedEffect("quantisation", "the scene has no noise.bits"))
    return left


def _of_estimate(scene: Scene) -> list[SkippedEffect]:
    left: list[SkippedEffect] = []
    if scene.prior.kind == "independent":
        left.append(SkippedEffect("covariances between pixels of the prior", "prior.kind is 'independent'"))
    if scene.calibration.method == "ideal":
        left.append(SkippedEffect("point sources", "calibration.method is 'ideal', H comes in closed form"))
        left.append(SkippedEffect("second estimate for the uncertainty of H", "the ideal H has none"))
    elif scene.prior.kind != "fit" and scene.estimator.noise_variance not in (None, "fit"):
        why = "estimator.noise_variance says what to expect"
        left.append(SkippedEffect("second estimate for the uncertainty of H", why))
    return left
