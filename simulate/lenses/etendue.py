"""How much light the surfaces of a real lens bring to the sensor: what electrons are counted from.

Projected solid angles, sr: the irradiance of a sensor point over the radiance of a uniform world, by rays that start
spread evenly over the exit pupil's disk. `ommatid.scenes.optics.radiometry` takes both of what is found for a camera.
"""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import corner_offset, poses

from .prescription import Prescription, prescription_of
from .ray_trace import Disk, exit_disk_of, path, reach, spread, trace

Array = NDArray[np.float64]
RAYS = 2**14
PLACES = 17  # off the axis, between which the light is taken to vary linearly


def solid_angle(
    prescription: Prescription, disk: Disk, depth: float, x: float = 0.0, y: float = 0.0, rays: int = RAYS
) -> float:
    """Projected solid angle, sr, from which light reaches a sensor point `depth` behind the rear principal plane."""
    across, down = spread(rays)
    weight: Array = trace(path(prescription, disk), x, y, across, down, depth)[2]
    return float(np.mean(weight) * pi * (disk.radius / (depth + disk.height)) ** 2)


def solid_angles(camera: Camera) -> dict[str, float]:
    """Of every lens type with surfaces, by name, on the axis. Raises InputError where a lens shows no image."""
    return {kind.name: float(_profile(camera, kind)[1][0]) for kind in camera.types if kind.optics.surfaces is not None}


def relative_illumination(camera: Camera) -> Array:
    """(M,) light at each sensor pixel's middle over that on its lens's axis; 1 of lens types without surfaces.

    Patches count as upright and at their design's depth.
    """
    found = np.ones(camera.measurements)
    profiles = {kind.name: _profile(camera, kind) for kind in camera.types if kind.optics.surfaces is not None}
    for sub, place, pose in zip(camera.sub_imagers, camera.slices(), poses(camera), strict=True):
        if sub.type.name not in profiles:
            continue
        row, column = (number.ravel() + 0.5 for number in np.indices(sub.type.pixels))
        u, v = corner_offset(camera, sub)
        points = pose.axes @ np.stack([u + column * camera.pixel_pitch, v + row * camera.pixel_pitch])
        x, y, _ = pose.middle[:, None] + points
        heights, light = profiles[sub.type.name]
        found[place] = np.interp(np.hypot(x, y), heights, light / light[0])
    return found


def _profile(camera: Camera, kind: LensType) -> tuple[Array, Array]:
    """Heights above the axis, and the projected solid angle at each."""
    lens, depth = prescription_of(camera, kind), camera.depth(kind)
    disk = exit_disk_of(camera, kind, lens)
    heights = np.linspace(0.0, reach(camera, kind)[0], PLACES)
    return heights, np.array([solid_angle(lens, disk, depth, height) for height in heights])
