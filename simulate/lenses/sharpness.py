"""What a lens type's lenses do to sharpness: diffraction, depth of field, and the spot that their rays make.

Lengths are millimetres. Depth of field is paraxial: a target at distance z, with the sensor at depth d behind a lens
that shows sharp what is at F, is blurred over the diameter

    b = d D |1 - z / F| / (z - e)

on the sensor, D the entrance pupil's diameter and e its distance before the plane of the lenses, 0 of a thin lens.
Spots are those of rays traced from a sensor point to the target, times the magnification.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import AIRY_FIRST_ZERO, GREEN
from ommatid.scenes.lens_type import LensType

from .prescription import Prescription, prescription_of
from .ray_trace import exit_disk_of, path, reach, spread, trace

Array = NDArray[np.float64]
RAYS = 4096


def describe(camera: Camera) -> list[dict[str, Any]]:
    """Of each lens type that is no pinhole, in JSON's types; distances beyond infinity are None.

    lens : its name;  focal_length, f_number;  working_f_number : of the cone of light at the sensor
    airy_diameter : of the first dark ring on the sensor;  airy_pixels : in sensor pixels
    near, far : between which a target is blurred over less than a sensor pixel; no depth of field: both None
    spot_axis, spot_corner : root mean square radius on the sensor, on the axis and at the farthest sensor point, None
        where no light arrives
    focus, sharpest : the distance that paraxial rays show sharp, and the one with the smallest spot on the axis
    """
    kinds = [kind for kind in camera.types if kind.optics.aperture is not None or kind.optics.surfaces is not None]
    return [_real(camera, kind) if kind.optics.surfaces is not None else _thin(camera, kind) for kind in kinds]


def words(found: dict[str, Any]) -> str:
    """The same in lines for a reader."""

    def mm(value: float | None) -> str:
        return "infinity" if value is None else f"{value:.4g} mm"

    def um(value: float | None) -> str:
        return "no light" if value is None else f"{value * 1e3:.3g} um"

    sharp = f"sharp from {mm(found['near'])} to {mm(found['far'])}"
    if found["near"] is None:
        sharp = "nowhere sharp to a pixel"
    return "\n".join(
        [
            f"focal length {mm(found['focal_length'])}, f/{found['f_number']:.3g}, at the sensor"
            f" f/{found['working_f_number']:.3g}",
            f"  Airy disk {um(found['airy_diameter'])}, {found['airy_pixels']:.3g} pixels; {sharp}",
            f"  spot (rms radius) {um(found['spot_axis'])} on the axis, {um(found['spot_corner'])} at the corner;"
            f" sharpest at {mm(found['sharpest'])}, by paraxial rays at {mm(found['focus'])}",
        ]
    )


def depth_of_field(
    depth: float, vergence: float, diameter: float, blur: float, pupil: float = 0.0
) -> tuple[float | None, float | None]:
    """Nearest and farthest distance that are blurred over less than `blur` on the sensor; None: infinity.

    depth : of the sensor;  vergence : 1 / distance shown sharp;  diameter : of the entrance pupil, `pupil` before z = 0
    """
    slope = blur / (depth * diameter)
    near = (1 + slope * pupil) / (vergence + slope) if vergence + slope > 0 else None
    far = (1 - slope * pupil) / (vergence - slope) if vergence - slope > 0 else None
    return near, far


def _thin(camera: Camera, kind: LensType) -> dict[str, Any]:
    diameter, depth, focus = kind.optics.aperture or 0.0, camera.depth(kind), camera.focus(kind)
    # A uniform disk's root mean square radius is its diameter over sqrt(8).
    spot = diameter * abs(1 - camera.distance / focus) * depth / camera.distance / sqrt(8)
    return {
        "lens": kind.name,
        "focal_length": camera.focal_length(kind),
        "f_number": camera.focal_length(kind) / diameter,
        **_diffraction(camera, depth / diameter),
        **_range(depth_of_field(depth, 1 / focus, diameter, camera.pixel_pitch)),
        "spot_axis": spot,
        "spot_corner": spot,
        "focus": focus,
        "sharpest": focus,
    }


def _real(camera: Camera, kind: LensType) -> dict[str, Any]:
    lens, depth = prescription_of(camera, kind), camera.depth(kind)
    entrance, vergence = lens.entrance_pupil, 1 / lens.focal_length - 1 / depth
    field, _, _ = reach(camera, kind)
    axis, corner = (_bundle(camera, kind, lens, height) for height in (0.0, field))
    before = lens.front_principal - entrance.position
    return {
        "lens": kind.name,
        "focal_length": lens.focal_length,
        "f_number": lens.f_number,
        **_diffraction(camera, lens.working_f_number(depth)),
        **_range(depth_of_field(depth, vergence, 2 * entrance.radius, camera.pixel_pitch, before)),
        "spot_axis": _on_sensor(_spot(*axis, camera.distance), depth / camera.distance),
        "spot_corner": _on_sensor(_spot(*corner, camera.distance), depth / camera.distance),
        "focus": 1 / vergence if vergence > 0 else None,
        "sharpest": _sharpest(*axis),
    }


def _diffraction(camera: Camera, working: float) -> dict[str, float]:
    airy = 2 * AIRY_FIRST_ZERO * (camera.wavelength or GREEN) * working
    return {"working_f_number": working, "airy_diameter": airy, "airy_pixels": airy / camera.pixel_pitch}


def _range(found: tuple[float | None, float | None]) -> dict[str, float | None]:
    return {"near": found[0], "far": found[1]}


def _bundle(camera: Camera, kind: LensType, lens: Prescription, height: float) -> tuple[Array, Array, Array]:
    """Where the rays of a sensor point cross the plane of the lenses, (2, rays), their slopes and their weights."""
    numbers = path(lens, exit_disk_of(camera, kind, lens))
    (x, y), (u, v, w), weight = trace(numbers, 0.0, height, *spread(RAYS), camera.depth(kind))
    brought = float(weight.sum())
    return np.array([x, y]), np.array([u / w, v / w]), weight / brought if brought > 0 else weight


def _moment(one: Array, other: Array, weight: Array) -> float:
    means = (one @ weight)[:, None], (other @ weight)[:, None]
    return float(np.sum(weight * (one - means[0]) * (other - means[1])))


def _spot(places: Array, slopes: Array, weight: Array, distance: float) -> float | None:
    """Root mean square radius about the centre, on a target at a distance; None where no light arrives."""
    if not weight.any():
        return None
    landed = places + distance * slopes
    return sqrt(_moment(landed, landed, weight))


def _on_sensor(spot: float | None, shrink: float) -> float | None:
    return None if spot is None else spot * shrink


def _sharpest(places: Array, slopes: Array, weight: Array) -> float | None:
    """The distance z with the smallest spot over z: the spot's square over z^2 is a parabola in 1 / z."""
    if not weight.any():
        return None
    vergence = -_moment(places, slopes, weight) / _moment(places, places, weight)
    return 1 / vergence if vergence > 0 else None
