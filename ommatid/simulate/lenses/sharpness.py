"""Sharpness of lenses: diffraction, depth of field, and spot sizes.

Lengths are millimetres. Depth of field is paraxial: a target at distance z, with the sensor at depth d behind a lens
that is focused at F, is blurred over the diameter

    b = d D |1 - z / F| / (z - e)

on the sensor, D the entrance pupil's diameter and e its distance before the plane of the lenses, 0 for a thin lens.
Spots are those of rays traced from a sensor point to the target, times the magnification.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import AIRY_FIRST_ZERO, GREEN
from ommatid.scenes.lens_type import LensType

from .field import LensField, field_of
from .point_spread import point_spread, strehl_ratio
from .prescription import prescription_of
from .wavefront import Wavefront, thin_wavefront


def describe(camera: Camera) -> list[dict[str, Any]]:
    """Describe each lens type that is not a pinhole, in JSON's types; infinite distances are None.

    lens : its name;  focal_length, f_number;  working_f_number : of the cone of light at the sensor
    airy_diameter : of the first dark ring on the sensor;  airy_pixels : in sensor pixels
    near, far : between which a target is blurred over less than a sensor pixel; both None without depth of field
    spot_axis, spot_corner : root mean square radius on the sensor, on the axis and at the farthest sensor point, None
        where no light arrives
    focus, sharpest : the distance in paraxial focus, and the one with the smallest spot on the axis
    strehl_axis, strehl_corner : Strehl ratio at the target's distance
    contrast_axis, contrast_corner : modulation transfer of the lens at half the sensor's Nyquist frequency, of the
        worse direction; these four None without a wavelength, or without light
    """
    lenses: list[dict[str, Any]] = []
    for lens_type in camera.types:
        if lens_type.optics.surfaces is not None:
            lenses.append(_real(camera, lens_type))
        elif lens_type.optics.aperture is not None:
            lenses.append(_thin(camera, lens_type, lens_type.optics.aperture))
    return lenses


def words(lens: dict[str, Any]) -> str:
    """Format the description of a lens as lines of text."""

    def mm(value: float | None) -> str:
        return "infinity" if value is None else f"{value:.4g} mm"

    def um(value: float | None) -> str:
        return "no light" if value is None else f"{value * 1e3:.3g} um"

    def share(value: float | None) -> str:
        return "unknown" if value is None else f"{value:.3f}"

    sharp = f"sharp from {mm(lens['near'])} to {mm(lens['far'])}"
    if lens["near"] is None:
        sharp = "nowhere sharp to a pixel"
    return "\n".join(
        [
            f"focal length {mm(lens['focal_length'])}, f/{lens['f_number']:.3g}, at the sensor"
            f" f/{lens['working_f_number']:.3g}",
            f"  Airy disk {um(lens['airy_diameter'])}, {lens['airy_pixels']:.3g} pixels; {sharp}",
            f"  spot (rms radius) {um(lens['spot_axis'])} on the axis, {um(lens['spot_corner'])} at the corner;"
            f" sharpest at {mm(lens['sharpest'])}, by paraxial rays at {mm(lens['focus'])}",
            f"  Strehl ratio {share(lens['strehl_axis'])} on the axis, {share(lens['strehl_corner'])} at the corner;"
            f" contrast at half of Nyquist {share(lens['contrast_axis'])} and {share(lens['contrast_corner'])}",
        ]
    )


def depth_of_field(
    depth: float, vergence: float, diameter: float, blur: float, pupil: float = 0.0
) -> tuple[float | None, float | None]:
    """Return the nearest and farthest distance blurred over less than `blur` on the sensor; None: infinity.

    depth : of the sensor;  vergence : 1 / focused distance;  diameter : of the entrance pupil, `pupil` before z = 0
    """
    slope = blur / (depth * diameter)
    near = (1 + slope * pupil) / (vergence + slope) if vergence + slope > 0 else None
    far = (1 - slope * pupil) / (vergence - slope) if vergence - slope > 0 else None
    return near, far


def _thin(camera: Camera, lens_type: LensType, diameter: float) -> dict[str, Any]:
    depth, focus = camera.depth(lens_type), camera.focus(lens_type)
    # A uniform disk's root mean square radius is its diameter over sqrt(8).
    spot = diameter * abs(1 - camera.distance / focus) * depth / camera.distance / sqrt(8)
    near, far = depth_of_field(depth, 1 / focus, diameter, camera.pixel_pitch)
    wavelength = camera.wavelength
    wave = None if wavelength is None else thin_wavefront(diameter, depth, camera.distance, focus, wavelength)
    return {
        "lens": lens_type.name,
        "focal_length": camera.focal_length(lens_type),
        "f_number": camera.focal_length(lens_type) / diameter,
        **_diffraction(camera, depth / diameter),
        "near": near,
        "far": far,
        "spot_axis": spot,
        "spot_corner": spot,
        "focus": focus,
        "sharpest": focus,
        **_contrasts(camera, depth, wave, wave),
    }


def _real(camera: Camera, lens_type: LensType) -> dict[str, Any]:
    lens, depth = prescription_of(camera, lens_type), camera.depth(lens_type)
    entrance, vergence = lens.entrance_pupil, 1 / lens.focal_length - 1 / depth
    field = field_of(camera, lens_type, None)
    before = lens.front_principal - entrance.position
    near, far = depth_of_field(depth, vergence, 2 * entrance.radius, camera.pixel_pitch, before)
    spots = [_spot(field.wave(height, None)) for height in (0.0, field.field)]
    spot_axis, spot_corner = (None if spot is None else spot * (depth / camera.distance) for spot in spots)
    return {
        "lens": lens_type.name,
        "focal_length": lens.focal_length,
        "f_number": lens.f_number,
        **_diffraction(camera, lens.working_f_number(depth)),
        "near": near,
        "far": far,
        "spot_axis": spot_axis,
        "spot_corner": spot_corner,
        "focus": 1 / vergence if vergence > 0 else None,
        "sharpest": _sharpest(field),
        **_contrasts(camera, depth, *_waves(camera, lens_type)),
    }


def _waves(camera: Camera, lens_type: LensType) -> tuple[Wavefront | None, Wavefront | None]:
    """Return the waves on the axis and at the corner; None for rays alone, and without light."""
    wavelength = camera.wavelength
    field = field_of(camera, lens_type, wavelength)
    if wavelength is None or field.rays_suffice:
        return None, None
    return field.wave(0.0, wavelength), field.wave(field.field, wavelength)


def _contrasts(camera: Camera, depth: float, axis: Wavefront | None, corner: Wavefront | None) -> dict[str, Any]:
    """Return Strehl ratios and contrasts by their keys."""
    frequency = depth / camera.distance / (4 * camera.pixel_pitch)  # half of Nyquist, on the target
    along = np.array([[frequency, 0.0], [0.0, frequency]])
    found: dict[str, Any] = {}
    for place, wave in (("axis", axis), ("corner", corner)):
        found[f"strehl_{place}"] = None if wave is None else strehl_ratio(wave)
        found[f"contrast_{place}"] = None if wave is None else float(point_spread(wave).transfer(along).min())
    return found


def _diffraction(camera: Camera, working: float) -> dict[str, float]:
    airy = 2 * AIRY_FIRST_ZERO * (camera.wavelength or GREEN) * working
    return {"working_f_number": working, "airy_diameter": airy, "airy_pixels": airy / camera.pixel_pitch}


def _spot(rays: Wavefront | None) -> float | None:
    """Return the root mean square radius of rays about their centre on the target; None if they carry no light."""
    return None if rays is None else float(np.sqrt(rays.light @ np.square(rays.hits).sum(axis=0)))


def _sharpest(field: LensField) -> float | None:
    """Return the distance z with the smallest spot over z, whose square is a parabola in 1 / z."""
    here, beyond = (replace(field, distance=times * field.distance).wave(0.0, None) for times in (1, 2))
    if here is None or beyond is None:
        return None
    slopes = (beyond.hits - here.hits) / field.distance
    points = here.hits - field.distance * slopes  # in the plane of the lenses
    vergence = -float((points * slopes @ here.light).sum() / (np.square(points) @ here.light).sum())
    return 1 / vergence if vergence > 0 else None
