"""The effects and computations that a scene does not need, each with the reason and the largest change it makes."""

from __future__ import annotations

from .camera import Camera
from .constants import AIRY_FIRST_ZERO, GREEN, WHITE
from .lens_type import LensType
from .optics.negligible import (
    SkippedEffect,
    change_by_diffraction,
    light_kept_in_focus,
    negligible_shot_noise,
    without_negligible_effects,
)
from .scene import Scene


def skipped_effects(scene: Scene, camera: Camera) -> tuple[SkippedEffect, ...]:
    """Return the effects skipped in rendering, recording, calibration and reconstruction, from the scene alone."""
    return (*_in_rendering(scene, camera), *_in_recording(scene, camera), *_in_estimation(scene))


def assumptions(scene: Scene, camera: Camera) -> tuple[str, ...]:
    """Return what the error bars take for granted and no measurement is asked about, a sentence each."""
    taken: list[str] = []
    if camera.has_width and not camera.wavelengths:
        taken.append("light is rays, which lenses do not diffract: remove camera.wavelength = 'none' for 550 nm")
    if ignores_detail(scene, camera):
        remedy = "set target.detail, with a correlated or fitted prior, to include finer detail"
        if camera.has_detail:
            remedy = "a prior of independent pixels says nothing of finer detail; take a correlated or fitted one"
        taken.append(f"the world is made of f's pixels: {remedy}")
    return tuple(taken)


def ignores_detail(scene: Scene, camera: Camera) -> bool:
    """True if the error depends on detail finer than f of which the scene says nothing."""
    return not (camera.covers_whole_pixels or (camera.has_detail and scene.prior.kind != "independent"))


def _in_rendering(scene: Scene, camera: Camera) -> list[SkippedEffect]:
    skipped: list[SkippedEffect] = []
    pinholes = [lens for lens in camera.types if lens.optics.aperture is None and lens.optics.surfaces is None]
    if pinholes:
        skipped.append(_without_aperture(camera, pinholes))
    if camera.has_width and not camera.wavelengths:
        skipped.append(_without_waves(camera))
    if camera.has_width and camera.walls:
        why = "walls between the sub-imagers keep it out (camera.walls)"
        skipped.append(SkippedEffect("light through neighbouring lenses", why))
    if scene.world is None:
        why = "there is nothing but the luminous target: paths have one segment"
        skipped.append(SkippedEffect("interreflection", why))
    if camera.detail > 1 and camera.covers_whole_pixels:
        skipped.append(SkippedEffect("detail", "every sensor pixel covers whole pixels of f"))
    return skipped + list(without_negligible_effects(scene, camera.world)[1])


def _without_aperture(camera: Camera, pinholes: list[LensType]) -> SkippedEffect:
    """The optics that pinholes lack, with what diffraction at apertures of the lens pitch would change."""
    numbers, widths, bounds = zip(*(_at_lens_pitch(camera, lens_type) for lens_type in pinholes), strict=True)
    which = "every lens is a pinhole" if len(pinholes) == len(camera.types) else "some lenses are pinholes"
    why = (
        f"{which} in focus: the most that lenses can achieve. Apertures of the lens pitch, f/{min(numbers):.2g}"
        f" to f/{max(numbers):.2g}, have Airy disks of {min(widths):.2g} to {max(widths):.2g} sensor pixels at 550 nm,"
        " and a light budget"
    )
    return SkippedEffect("aperture and diffraction", why, max(bounds))


def _at_lens_pitch(camera: Camera, lens_type: LensType) -> tuple[float, float, float]:
    """The f-number of an aperture of the lens pitch, its Airy disk in sensor pixels, and a bound on its effect."""
    number = camera.depth(lens_type) / camera.lens_pitch
    width = 2 * AIRY_FIRST_ZERO * GREEN * number / camera.pixel_pitch
    return number, width, WHITE * (1 - light_kept_in_focus(camera.pixel_pitch / (GREEN * number)))


def _without_waves(camera: Camera) -> SkippedEffect:
    """The diffraction that rays lack. Its bound is that of thin lenses; lenses with surfaces have none here."""
    why = "camera.wavelength is 'none': light is rays"
    bounds = [
        change_by_diffraction(camera, lens_type, lens_type.optics.aperture, camera.focus(lens_type))
        for lens_type in camera.types
        if lens_type.optics.aperture is not None
    ]
    if any(lens_type.optics.surfaces is not None for lens_type in camera.types):
        why += ", also behind surfaces, where diffraction has no bound"
        bounds = [WHITE]
    return SkippedEffect("diffraction", why, max(bounds))


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
