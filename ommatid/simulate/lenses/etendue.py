"""Light that the surfaces of a real lens bring to the sensor, as projected solid angles, sr.

The irradiance of a sensor point over the radiance of a uniform world, from rays that start evenly spread over the exit
pupil's disk. `ommatid.scenes.optics.radiometry` computes electrons from it, and from the share of light that surfaces
transmit: each reflects ((n - n') / (n + n'))^2 at normal incidence (Fresnel). For the rays of the gallery's lenses,
unpolarised, that is right to 4e-5; light that is reflected twice is left out.
"""

from __future__ import annotations

from math import pi

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import corner_offset, poses

from .prescription import Prescription, prescription_of
from .ray_trace import Disk, exit_disk_of, path, reach, spread, trace

RAYS = 2**14
HEIGHTS = 17  # off the axis, between which the light is interpolated linearly


def solid_angle(
    prescription: Prescription, disk: Disk, depth: float, x: float = 0.0, y: float = 0.0, rays: int = RAYS
) -> float:
    """Return the projected solid angle, sr, of the light at a point `depth` behind the rear principal plane."""
    across, down = spread(rays)
    weight: FloatArray = trace(path(prescription, disk), x, y, across, down, depth)[2]
    return float(np.mean(weight) * pi * (disk.radius / (depth + disk.height)) ** 2)


def solid_angles(camera: Camera) -> dict[str, float]:
    """Return the projected solid angle on the axis of each lens type with surfaces, by name.

    Raises InputError for a lens that forms no image.
    """
    return {name: float(light[0]) for name, (_, light) in _profiles(camera).items()}


def transmissions(camera: Camera) -> dict[str, float]:
    """Return the share of light that the surfaces of each lens type transmit, by name; 1 less reflection losses.

    A coating's reflectance takes the place of Fresnel's at surfaces between glass and air.
    """
    return {
        lens_type.name: transmission(prescription_of(camera, lens_type), lens_type.optics.coating)
        for lens_type in camera.types
        if lens_type.optics.surfaces is not None
    }


def transmission(prescription: Prescription, coating: float | None = None) -> float:
    """Return the share of light that the surfaces of a lens transmit along the axis."""
    before, behind = prescription.index_before, prescription.index
    reflected = np.square((behind - before) / (behind + before))
    if coating is not None:
        reflected = np.where((before == 1) != (behind == 1), coating, reflected)
    return float(np.prod(1 - reflected))


def relative_illumination(camera: Camera) -> FloatArray:
    """Return the light in the middle of each sensor pixel relative to its lens's axis, (M,); 1 without surfaces.

    Patches count as upright and at their designed depth.
    """
    illumination = np.ones(camera.measurements)
    profiles = _profiles(camera)
    for sub, rows, pose in zip(camera.sub_imagers, camera.slices(), poses(camera), strict=True):
        if sub.type.name not in profiles:
            continue
        row, column = (index.ravel() + 0.5 for index in np.indices(sub.type.pixels))
        u, v = corner_offset(camera, sub)
        points = pose.axes @ np.stack([u + column * camera.pixel_pitch, v + row * camera.pixel_pitch])
        x, y, _ = pose.middle[:, None] + points
        heights, light = profiles[sub.type.name]
        illumination[rows] = np.interp(np.hypot(x, y), heights, light / light[0])
    return illumination


def _profiles(camera: Camera) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Heights above the axis and the projected solid angle at each, by the name of a lens type with surfaces."""
    return {lens.name: _profile(camera, lens) for lens in camera.types if lens.optics.surfaces is not None}


def _profile(camera: Camera, lens_type: LensType) -> tuple[FloatArray, FloatArray]:
    lens, depth = prescription_of(camera, lens_type), camera.depth(lens_type)
    disk = exit_disk_of(camera, lens_type, lens)
    heights = np.linspace(0.0, reach(camera, lens_type)[0], HEIGHTS)
    return heights, np.array([solid_angle(lens, disk, depth, height) for height in heights])
