"""Rays from a sensor point through an ideal thin lens.

Plain functions of coordinates; the arrays may be NumPy's or Dr.Jit's. Lengths are millimetres from the centre of the
lens: the sensor at z = -depth, the target at z > 0. The image on the sensor is upside down, sub-images are upright:
pixel (0, 0) of a sub-image looks at the top left of its window and has the smallest x and y.
"""

from __future__ import annotations

from typing import Any


def through_centre(x: Any, y: Any, depth: Any) -> tuple[Any, Any]:
    """Return the slopes dx/dz and dy/dz of the ray from (x, y, -depth) through the lens's centre."""
    return -x / depth, -y / depth


def through_thin_lens(slope: Any, position: Any, depth: Any, focal_length: Any) -> Any:
    """Return the slope, along one axis, behind a thin lens of a ray that crosses it at `position`.

    `slope` is that of the ray through the lens's centre. All rays of one sensor point meet where that one has gone
    1/(1/focal_length - 1/depth) from the lens (the thin-lens equation).
    """
    return slope + position / depth - position / focal_length


def falloff(x: Any, y: Any, lens_x: Any, lens_y: Any, depth: Any) -> Any:
    """Return cos^4 of the angle, at the sensor, of the ray from (x, y, -depth) to the point (lens_x, lens_y, 0).

    The irradiance that an element of the lens contributes, relative to the axis: cos at the lens, cos at the sensor,
    and cos^2 for the distance.
    """
    square = ((x - lens_x) * (x - lens_x) + (y - lens_y) * (y - lens_y)) / (depth * depth)
    return 1 / ((1 + square) * (1 + square))
