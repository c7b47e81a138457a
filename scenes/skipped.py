"""The effects and computations that a scene does not need, each with the reason and the largest change it makes."""

from __future__ import annotations

from .camera import Camera
from .optics.negligible import SkippedEffect, negligible_shot_noise, without_negligible_effects
from .scene import Scene


def skipped_effects(scene: Scene, camera: Camera) -> tuple[SkippedEffect, ...]:
    """Return the effects skipped in rendering, recording, calibration and reconstruction, from the scene alone."""
    return (*_in_rendering(scene, camera), *_in_recording(scene, camera), *_in_estimation(scene))


def assumptions(scene: Scene, camera: Camera) -> tuple[str, ...]:
    """Return what the error bars take for granted and no measurement is asked about, a sentence each."""
    if camera.covers_whole_pixels or (camera.has_detail and scene.prior.kind != "independent"):
        return ()
    remedy = "set target.detail, with a correlated or fitted prior, to include finer detail"
    if camera.has_detail:
        remedy = "a prior of independent pixels says nothing of finer detail; take a correlated or fitted one"
    return (f"the world is made of f's pixels: {remedy}",)


def _in_rendering(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    skipped: list[SkippedEffect] = []
    if all(lens_type.optics.aperture is None and lens_type.optics.surfaces is None for lens_type in camera.types):
        skipped.append(SkippedEffect("samples of an aperture", "every lens is a pinhole in focus"))
    elif camera.wavelength is None:
        skipped.append(SkippedEffect("diffraction", "the scene has no camera.wavelength: light is rays"))
    if scene.world is None:
        why = "there is nothing but the luminous target: paths have one segment"
        skipped.append(SkippedEffect("interreflection", why))
    if camera.detail > 1 and camera.covers_whole_pixels:
        skipped.append(SkippedEffect("detail", "every sensor pixel covers whole pixels of f"))
    return skipped + list(without_negligible_effects(scene, camera.world)[1])


def _in_recording(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    if scene.sensor is not None:
        shot = negligible_shot_noise(scene, camera)
        return [] if shot is None else [shot, SkippedEffect("second estimate for the shot noise", shot.why)]
    if scene.noise is None:
        return [SkippedEffect("sensor noise and quantisation", "the scene has no [noise] and no [sensor]")]
    skipped: list[SkippedEffect] = []
    if scene.noise.variance == 0:
        skipped.append(SkippedEffect("sensor noise", "noise.variance is 0"))
    if scene.noise.bits is None:
        skipped.append(SkippedEffect("quantisation", "the scene has no noise.bits"))
    return skipped


def _in_estimation(scene: Scene) -> list[SkippedEffect]:
    skipped: list[SkippedEffect] = []
    if scene.prior.kind == "independent":
        skipped.append(SkippedEffect("covariances between pixels of the prior", "prior.kind is 'independent'"))
    if scene.calibration.method == "ideal":
        skipped.append(SkippedEffect("point sources", "calibration.method is 'ideal': H has a closed form"))
        skipped.append(SkippedEffect("second estimate for the uncertainty of H", "the ideal H has none"))
    elif scene.prior.kind != "fit" and scene.estimator.noise_variance not in (None, "fit"):
        why = "estimator.noise_variance fixes the expected noise"
        skipped.append(SkippedEffect("second estimate for the uncertainty of H", why))
    return skipped
