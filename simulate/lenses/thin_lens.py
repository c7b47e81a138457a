"""How a ray leaves a sensor point through an ideal lens.

Plain functions of coordinates; the arrays may be NumPy's or Dr.Jit's. Lengths are millimetres, seen from the centre
of the lens: the sensor at z = -depth, the target at z > 0. The image on the sensor is upside down, sub-images are
upright: pixel (0, 0) of a sub-image looks at the top left of its window and stands at the smallest x and y.
"""

from __future__ import annotations

from typing import Any


def through_centre(x: Any, y: Any, depth: Any) -> tuple[Any, Any]:
    """Slopes dx/dz and dy/dz of the ray from (x, y, -depth) through the lens's centre, which no thin lens bends."""
    return -x / depth, -y / depth


def through_thin_lens(slope: Any, place: Any, depth: Any, focal_length: Any) -> Any:
    """Slope, along one axis, behind a thin lens of a ray that passes it at `place`.

    `slope` is the one of the ray through the lens's centre. All rays of one sensor point meet where that one has gone
    1/(1/focal_length - 1/depth) from the lens (the thin-lens equation).
    """
    return slope + place / depth - place / focal_length


def falloff(x: Any, y: Any, place_x: Any, place_y: Any, depth: Any) -> Any:
    """cos^4 of the angle at which the ray from (x, y, -depth) to a place on the lens leaves the sensor.

    The irradiance that an element of the lens brings to the sensor: cos at the lens, cos at the sensor, and cos^2 for
    the distance, in units of what it brings on the axis.
    """
    square = ((x - place_x) * (x - place_x) + (y - place_y) * (y - place_y)) / (depth * depth)
    return 1 / ((1 + square) * (1 + square))
