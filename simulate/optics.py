"""How a ray leaves a sensor pixel through its lens.

Plain functions of coordinates; the arrays may be NumPy's or Dr.Jit's. Lengths are millimetres, seen from the centre
of the lens: the sensor at z = -depth, the target at z > 0. The image on the sensor is upside down, sub-images are
upright: pixel (0, 0) of a sub-image looks at the top left of its window and stands at the smallest x and y.
"""

from __future__ import annotations

from typing import Any

from scenes.camera import Camera, SubImager


def pixel_corner(camera: Camera, sub: SubImager, row: Any, column: Any) -> tuple[Any, Any]:
    """(x, y) on the sensor, from the lens's centre, of the corner where pixel (row, column) begins."""
    x = (sub.patch[0] - sub.lens[0]) + (column - sub.type.pixels[1] / 2) * camera.pixel_pitch
    y = (sub.patch[1] - sub.lens[1]) + (row - sub.type.pixels[0] / 2) * camera.pixel_pitch
    return x, y


def through_pinhole(x: Any, y: Any, depth: Any) -> tuple[Any, Any, Any]:
    """Direction, not normalised, of the ray from (x, y, -depth) through the lens's centre."""
    return -x, -y, depth
