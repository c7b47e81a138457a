"""What lenses do to an image: diffraction, depth of field, spots, aberrations, distortion and shading.

Lengths are millimetres. Depth of field is paraxial: a target at distance z, with the sensor at depth d behind a lens
that is focused at F, is blurred over the diameter

    b = d D |1 - z / F| / (z - e)

on the sensor, D the entrance pupil's diameter and e its distance before the plane of the lenses, 0 for a thin lens.
Spots are those of rays traced from a sensor point to the target, times the magnification. The rim is the sensor point
that is farthest from the lens's axis.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray

from ..camera import Camera
from ..constants import AIRY_FIRST_ZERO, GREEN
from ..geometry.optical_terms import ThroughFocus
from ..lens_type import LensType
from . import distortion
from .field import LEAST_VERGENCE, Optics, optics_of
from .point_spread import grid_of, point_spread, strehl_ratio
from .wavefront import Wavefront

ROUNDING = 1e-9  # relative difference of vergences that are equal
FOCUS_STEPS = 21  # of a curve through focus
FOCUS_ZEROS = 1.5  # its ends, times the shift N / frequency; a disk of rays has its first zero at 1.22
FOCUS_WAVES = 10.0  # of defocus, at most at its ends


def describe(camera: Camera) -> list[dict[str, Any]]:
    """Describe each lens type that is not a pinhole, in JSON's types; infinite distances are None.

    lens : its name;  focal_length, f_number;  working_f_number : of the cone of light at the sensor
    airy_diameter : of the first dark ring on the sensor;  airy_pixels : in sensor pixels
    near, far : between which a target is blurred over less than a sensor pixel; both None without depth of field
    focus : distance in paraxial focus;  sharpest_axis, sharpest_rim : distances with the smallest spots
    curvature : of the field: from the sensor's plane to where the sharpest image of the rim is while the axis is
        sharpest there, positive behind the plane
    spot_axis, spot_rim : root mean square radius on the sensor
    wavefront_axis, wavefront_rim : root mean square error of the wave, in wavelengths, defocus included, tilt left out
    strehl_axis, strehl_rim : Strehl ratio at the target's distance
    contrast_axis, contrast_rim : modulation transfer of the lens at half the sensor's Nyquist frequency, of the worse
        direction
    distortion : relative change of the magnification at the rim;  illumination : light there, relative to the axis
    Where no light arrives, and for waves where light is rays, values are None.
    """
    return [_described(camera, lens_type) for lens_type in camera.types if lens_type.optics.has_width]


def depth_of_field(
    depth: float, vergence: float, diameter: float, blur: float, pupil: float = 0.0
) -> tuple[float | None, float | None]:
    """Return the nearest and farthest distance blurred over less than `blur` on the sensor; None: infinity.

    depth : of the sensor;  vergence : 1 / focused distance;  diameter : of the entrance pupil, `pupil` before z = 0
    """
    slope = blur / (depth * diameter)
    near = (1 + slope * pupil) / (vergence + slope) if vergence + slope > 0 else None
    beyond = vergence - slope
    far = (1 - slope * pupil) / beyond if beyond > ROUNDING * slope else None
    return near, far


def _described(camera: Camera, lens_type: LensType) -> dict[str, Any]:
    rays, depth = optics_of(camera, lens_type, None), camera.depth(lens_type)
    (diameter, before), vergence = rays.entrance_pupil, 1 / rays.focal_length - 1 / depth
    near, far = depth_of_field(depth, vergence, diameter, camera.pixel_pitch, before)
    airy = 2 * AIRY_FIRST_ZERO * (camera.wavelength or GREEN) * rays.working_f_number
    axis, rim = (_at_height(camera, lens_type, height) for height in (0.0, rays.field))
    sharpest = [_vergence_of_least_spot(rays, height) for height in (0.0, rays.field)]
    bend = None if sharpest[0] is None or sharpest[1] is None else -(depth**2) * (sharpest[1] - sharpest[0])
    return {
        "lens": lens_type.name,
        "focal_length": rays.focal_length,
        "f_number": rays.focal_length / diameter,
        "working_f_number": rays.working_f_number,
        "airy_diameter": airy,
        "airy_pixels": airy / camera.pixel_pitch,
        "near": near,
        "far": far,
        "focus": _distance(vergence),
        "sharpest_axis": _distance(sharpest[0]),
        "sharpest_rim": _distance(sharpest[1]),
        "curvature": bend,
        **{f"{name}_axis": value for name, value in axis.items()},
        **{f"{name}_rim": value for name, value in rim.items()},
        "distortion": None if rim["spot"] is None else _distortion(camera, lens_type, rays),
        "illumination": float(rays.weight(np.array([rays.field]))[0] / rays.weight(np.zeros(1))[0]),
    }


def _at_height(camera: Camera, lens_type: LensType, height: float) -> dict[str, float | None]:
    """Return spot, wavefront error, Strehl ratio and contrast at a height of the sensor point."""
    wavelength = camera.wavelength
    field = optics_of(camera, lens_type, wavelength)
    rays = field.wave(height, None)
    wave = None if wavelength is None or rays is None or field.rays_suffice else field.wave(height, wavelength)
    return {
        "spot": None if rays is None else _spot(rays) * camera.optical_magnification(lens_type),
        "wavefront": None if wave is None else _wavefront_error(wave),
        "strehl": None if wave is None else strehl_ratio(wave),
        "contrast": None if wave is None else _contrast(camera, field, wave),
    }


def _contrast(camera: Camera, field: Optics, wave: Wavefront, grid: tuple[float, float] | None = None) -> float:
    """Return the modulation transfer at half the sensor's Nyquist frequency, of the worse direction."""
    frequency = field.depth / field.distance / (4 * camera.pixel_pitch)  # on the target
    return float(point_spread(wave, grid).transfer(np.array([[frequency, 0.0], [0.0, frequency]])).min())


def through_focus(camera: Camera) -> list[ThroughFocus]:
    """Return the curves of the lens types whose light is waves and reaches the rim."""
    curves: list[ThroughFocus] = []
    for lens_type in camera.types:
        if not lens_type.optics.has_width or camera.wavelength is None:
            continue
        field, depth = optics_of(camera, lens_type, camera.wavelength), camera.depth(lens_type)
        if field.rays_suffice or field.wave(field.field, None) is None:
            continue
        number = field.working_f_number
        last = min(FOCUS_ZEROS * 4 * camera.pixel_pitch * number, FOCUS_WAVES * 8 * camera.wavelength * number**2)
        shifts = np.linspace(-last, last, FOCUS_STEPS)
        contrasts = [_contrasts(camera, field, height, shifts / depth**2) for height in (0.0, field.field)]
        curves.append(ThroughFocus(lens_type.name, shifts, *contrasts))
    return curves


def _contrasts(camera: Camera, field: Optics, height: float, vergences: FloatArray) -> FloatArray:
    """Return the contrast of a lit sensor point at changes of its vergence: a quadratic phase over the pupil."""
    rays = field.outline(height)
    blur = field.pupil_radius * field.distance * float(np.abs(vergences).max())
    half = rays.extent + blur
    wave = field.lit_wave(height, half)
    across = wave.cosines - (wave.cosines @ wave.light)[:, None]
    bend = np.square(field.distance * across).sum(axis=0) / 2
    grid = grid_of(wave)[0], half
    moved = (replace(wave, path=wave.path - vergence * bend) for vergence in vergences)
    return np.array([_contrast(camera, field, each, grid) for each in moved])


def _spot(rays: Wavefront) -> float:
    """Return the root mean square radius of rays about their centre on the target."""
    return float(np.sqrt(rays.light @ np.square(rays.hits).sum(axis=0)))


def _wavefront_error(wave: Wavefront) -> float:
    """Return the root mean square of the path over the pupil, in wavelengths, without its mean and tilt."""
    if wave.wavelength is None:
        raise ValueError("expected a wave with a wavelength, got rays alone")
    root, terms = np.sqrt(wave.light), np.stack([np.ones_like(wave.path), *wave.cosines], axis=1)
    plane = np.linalg.lstsq(root[:, None] * terms, root * wave.path, rcond=None)[0]
    return float(np.sqrt(wave.light @ np.square(wave.path - terms @ plane))) / wave.wavelength


def _vergence_of_least_spot(field: Optics, height: float) -> float | None:
    """Return 1 / distance z of the smallest spot over z, whose square is a parabola in 1 / z; None without light."""
    here, beyond = (replace(field, distance=times * field.distance).wave(height, None) for times in (1, 2))
    if here is None or beyond is None:
        return None
    slopes = (beyond.hits - here.hits) / field.distance
    points = here.hits - field.distance * slopes  # in the plane of the lenses
    return -float((points * slopes @ here.light).sum() / (np.square(points) @ here.light).sum())


def _distance(vergence: float | None) -> float | None:
    return 1 / vergence if vergence is not None and vergence > LEAST_VERGENCE else None


def _distortion(camera: Camera, lens_type: LensType, rays: Optics) -> float:
    """Return the relative change of the magnification at the rim, which gets light."""
    given, height = lens_type.optics.distortion, rays.field
    if given is not None:
        limit = distortion.largest_field(camera, lens_type)
        tangent, scale = height / rays.depth, camera.distance_of(lens_type) / camera.half_diagonal
        return tangent / float(distortion.undistort(tangent, 0.0, *given, scale, limit)[0]) - 1
    if lens_type.optics.surfaces is None:
        return 0.0
    seen = float(np.hypot(*rays.chief_ray(np.zeros(1), np.array([height])))[0])
    return height * rays.distance / (rays.depth * seen) - 1
