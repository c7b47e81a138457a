"""Radial distortion: how a lens's magnification changes from its axis outwards.

A chief ray is its tangent (x, y) to the lens's axis, on the target's side and on the sensor's side. With r = 1 at
`1 / scale`, for a camera's targets Camera.half_diagonal / Camera.distance,

    image tangent = object tangent (1 + k1 r^2 + k2 r^4).

Functions of tangents use nothing but operators and abs(): they serve numbers and arrays of NumPy and Dr.Jit alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..lens_type import SubImager
from ..pose import Pose

ITERATIONS = 10  # for |k1|, |k2| up to 0.3 and r up to 1.5 7 reach rounding, and 5 that of float32
LOST = 1e-9  # r that undistort may be wrong by, times the derivative


def distort(x: Any, y: Any, k1: Any, k2: Any, scale: Any) -> tuple[Any, Any]:
    """Image tangents of object tangents (x, y)."""
    squared = (x * x + y * y) * (scale * scale)
    factor = 1 + squared * (k1 + squared * k2)
    return x * factor, y * factor


def undistort(
    x: Any, y: Any, k1: Any, k2: Any, scale: Any, limit: Any, iterations: int = ITERATIONS
) -> tuple[Any, Any]:
    """Object tangents of image tangents (x, y), by Newton's method.

    limit : largest r that matters, as `field` tells it; up to it nothing must fold. Beyond, the lens is taken to
        magnify as it does there, so that every ray has a direction, and one that leaves the target stays outside

    The unknown is q, object over image tangent: q + a q^3 + b q^5 = 1 with a = k1 r'^2, b = k2 r'^4, and r' of the
    image tangent.
    """
    square = limit * limit
    factor = 1 + square * (k1 + square * k2)
    most = square * factor * factor
    squared = (x * x + y * y) * (scale * scale)
    squared = (squared + most - abs(squared - most)) / 2  # the smaller one
    a, b = k1 * squared, k2 * squared * squared
    q = 1 / (1 + (factor - 1) / most * squared)  # right at the axis and at the limit
    for _ in range(iterations):
        s = q * q
        q = q - (q * (1 + s * (a + s * b)) - 1) / (1 + s * (3 * a + s * (5 * b)))
    return x * q, y * q


def coefficients(sub: SubImager) -> tuple[float, float]:
    """k1 and k2 of a sub-imager's lens, 0 where it has none."""
    return sub.type.optics.distortion or (0.0, 0.0)


def field(camera: Camera, sub: SubImager, pose: Pose) -> float:
    """Largest r of the target as a sub-imager's lens sees it.

    Raises InputError if the image folds within, if the derivative of r (1 + k1 r^2 + k2 r^4) is not positive, or if
    `undistort` fails there, which takes a k1 or k2 of about 1.
    """
    across, down = camera.position(0, 0)
    limit = float(np.hypot(across + abs(pose.lens[0]), down + abs(pose.lens[1]))) / camera.half_diagonal
    if sub.type.optics.distortion is not None:
        fault = _fault(*sub.type.optics.distortion, limit)
        if fault:
            k1, k2 = sub.type.optics.distortion
            raise InputError(
                f"camera.lens.{sub.type.name}.distortion: [{k1:g}, {k2:g}] {fault} the target, which reaches to"
                f" r = {limit:.3g} as {sub.name} sees it; use smaller k1 and k2"
            )
    return limit


def _fault(k1: float, k2: float, limit: float) -> str:
    """What is wrong with a distortion up to r = `limit`, or nothing."""
    turning = -3 * k1 / (10 * k2) if k2 > 0 else 0.0  # r^2 where the derivative, a parabola in r^2, is least
    squares = np.array([limit**2, min(max(turning, 0.0), limit**2)])
    if (1 + squares * (3 * k1 + squares * 5 * k2)).min() <= 0:
        return "folds (1 + 3 k1 r^2 + 5 k2 r^4 is not above 0 everywhere) the image of"
    radius = np.linspace(0, limit, 257)
    back, _ = undistort(distort(radius, 0.0, k1, k2, 1.0)[0], 0.0, k1, k2, 1.0, limit)
    lost = np.abs(back - radius) * (1 + radius**2 * (3 * k1 + radius**2 * 5 * k2))
    return "" if float(lost.max()) < LOST * limit else "bends chief rays too strongly to follow them back to"
