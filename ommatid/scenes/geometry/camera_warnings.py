"""Warnings about a camera as described: effects that matter and are left out, and quantities that no camera has."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

from ..camera import Camera
from ..constants import AIRY_FIRST_ZERO, GREEN, WHITE
from ..scene import Scene
from .optical_terms import LensTerms, OpticalTerms

WIDEST = 1.0  # sensor pixels, of an Airy disk that may be left out
FASTEST = 0.5  # f-number of a sharp lens in air: 1 / (2 sin(angle)) of a cone of 90 degrees to the axis (Abbe)
FULL_WELL = 10000  # electrons of a common pixel, the default of [sensor]
WIDEST_VIEW = 120.0  # degrees: beyond, the cos^4 law leaves less than 1/16 of the light at the edge


def camera_warnings(scene: Scene, camera: Camera, terms: OpticalTerms) -> list[str]:
    """Return one sentence per warning, which names the keys to change."""
    return [*_without_noise(scene), *_left_out(camera, terms), *_absurd(camera, terms)]


def _without_noise(scene: Scene) -> list[str]:
    """The least noise that a sensor has is that of its electrons: the root of their number."""
    if scene.noise is not None or scene.sensor is not None:
        return []
    return [
        "sensor noise is not modelled: add [noise] or [sensor]; photons alone bring a deviation of"
        f" {WHITE / sqrt(FULL_WELL):.3g} of {WHITE:g} to a pixel of {FULL_WELL} electrons"
    ]


def _left_out(camera: Camera, terms: OpticalTerms) -> list[str]:
    warnings: list[str] = []
    thin = [lens for lens in terms.types if lens.airy_diameter is not None]
    if not camera.wavelengths and thin:
        wide = [lens for lens in thin if (lens.airy_diameter or 0) > WIDEST]
        if wide:
            disks = _each(wide, lambda lens: f"{lens.airy_diameter:.2g}")
            warnings.append(
                f"diffraction is not modelled: set camera.wavelength; the Airy disk of {disks} sensor pixels wide at"
                f" {terms.wavelength * 1e6:.4g} nm"
            )
    if terms.lenses > 1:  # a single lens may be wider than the pitch
        warnings += _pinholes(camera, terms)
    return warnings


def _pinholes(camera: Camera, terms: OpticalTerms) -> list[str]:
    def narrowest(lens: LensTerms) -> float:
        return 2 * AIRY_FIRST_ZERO * GREEN * lens.total_track / camera.lens_pitch / camera.pixel_pitch

    pinholes = [lens for lens, kind in zip(terms.types, camera.types, strict=True) if not kind.optics.has_width]
    wide = [lens for lens in pinholes if narrowest(lens) > WIDEST]
    if not wide:
        return []
    disks = _each(wide, lambda lens: f"{narrowest(lens):.2g}")
    return [
        f"diffraction is not modelled: set camera.lens.{wide[0].name}.aperture or f_number; even behind an aperture of"
        f" the lens pitch, the Airy disk of {disks} sensor pixels wide at 550 nm"
    ]


def _absurd(camera: Camera, terms: OpticalTerms) -> list[str]:
    warnings: list[str] = []
    for lens in terms.types:
        name = f"lens type {lens.name}"
        if lens.f_number is not None and lens.f_number < FASTEST:
            warnings.append(f"{name} is f/{lens.f_number:.2g}: no lens in air is faster than f/0.5; make it narrower")
        if lens.airy_diameter is not None and lens.airy_diameter * camera.pixel_pitch > min(lens.sub_image):
            warnings.append(
                f"the Airy disk of {name} is {lens.airy_diameter:.3g} sensor pixels wide, wider than its sub-image;"
                " make its aperture wider"
            )
        if lens.magnification > 1:
            warnings.append(
                f"{name} enlarges the target {lens.magnification:.3g} times, with the sensor behind it farther away"
                " than the target; check target.pixel_pitch and camera.pixel_pitch"
            )
        if max(lens.field_of_view) > WIDEST_VIEW:
            warnings.append(
                f"{name} has a field of view of {max(lens.field_of_view):.0f} degrees, where a flat sensor gets less"
                " than 1/16 of the light at the edge; make target.distance longer or the sub-images smaller"
            )
    if camera.pixel_pitch < terms.wavelength / 2:
        warnings.append(
            f"camera.pixel_pitch is {camera.pixel_pitch * 1e3:.3g} um, less than half of the wavelength,"
            f" {terms.wavelength * 1e6:.4g} nm: no image has such detail"
        )
    return warnings


def _each(lenses: list[LensTerms], number: Callable[[LensTerms], str]) -> str:
    """Lens types with a number each, as the subject of a sentence and its verb: "lens I is 3.5, of lens II 2.1"."""
    first, *others = lenses
    return ", ".join([f"lens {first.name} is {number(first)}", *(f"of lens {x.name} {number(x)}" for x in others)])
