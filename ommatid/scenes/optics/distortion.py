"""Radial distortion: the change of a lens's magnification with the distance from its axis.

A chief ray is described by its tangents (x, y) to the lens's axis, on the target's side and on the sensor's side. With
r = 1 at the tangent 1 / `scale`, which for a camera is Camera.half_diagonal / Camera.distance,

    image tangent = object tangent (1 + k1 r^2 + k2 r^4).

Functions of tangents use only operators and abs(), so that they work on floats and on arrays of NumPy and Dr.Jit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..lens_type import LensType, SubImager
from ..pose import Pose, poses

ITERATIONS = 10  # for |k1|, |k2| up to 0.3 and r up to 1.5, 7 are enough for float64 and 5 for float32
LARGEST_ERROR = 1e-9  # of undistort in r, times the derivative


def distort(x: Any, y: Any, k1: Any, k2: Any, scale: Any) -> tuple[Any, Any]:
    """Image tangents of object tangents (x, y)."""
    squared = (x * x + y * y) * (scale * scale)
    factor = 1 + squared * (k1 + squared * k2)
    return x * factor, y * factor


def undistort(x: Any, y: Any, k1: Any, k2: Any, scale: Any, limit: Any) -> tuple[Any, Any]:
    """Object tangents of image tangents (x, y), by Newton's method.

    limit : largest r needed, from `field`; up to it the image must not fold. Beyond it the magnification is that at
        `limit`, so that every ray has a direction, and rays that miss the target still miss it

    The unknown is q, object over image tangent: q + a q^3 + b q^5 = 1 with a = k1 r'^2, b = k2 r'^4, and r' of the
    image tangent.
    """
    square = limit * limit
    factor = 1 + square * (k1 + square * k2)
    most = square * factor * factor
    squared = (x * x + y * y) * (scale * scale)
    squared = (squared + most - abs(squared - most)) / 2  # min(squared, most)
    a, b = k1 * squared, k2 * squared * squared
    q = 1 / (1 + (factor - 1) / most * squared)  # exact on the axis and at the limit
    for _ in range(ITERATIONS):
        s = q * q
        q = q - (q * (1 + s * (a + s * b)) - 1) / (1 + s * (3 * a + s * (5 * b)))
    return x * q, y * q


def coefficients(sub: SubImager) -> tuple[float, float]:
    """k1 and k2 of a sub-imager's lens, 0 without distortion."""
    return sub.type.optics.distortion or (0.0, 0.0)


def field(camera: Camera, sub: SubImager, pose: Pose) -> float:
    """Largest r of the target around a sub-imager's axis.

    Raises InputError if the image folds up to there, that is if the derivative of r (1 + k1 r^2 + k2 r^4) is not
    positive, or if `undistort` fails, which takes a k1 or k2 of about 1.
    """
    x, y = camera.position(0, 0)
    limit = float(np.hypot(x + abs(pose.lens[0]), y + abs(pose.lens[1]))) / camera.half_diagonal
    if sub.type.optics.distortion is not None:
        fault = _fault(*sub.type.optics.distortion, limit)
        if fault:
            k1, k2 = sub.type.optics.distortion
            raise InputError(
                f"camera.lens.{sub.type.name}.distortion: [{k1:g}, {k2:g}] {fault} the target, which reaches to"
                f" r = {limit:.3g} for {sub.name}; use smaller k1 and k2"
            )
    return limit


def largest_field(camera: Camera, lens_type: LensType) -> float:
    """Largest r of the target around the axes of a lens type's sub-imagers. Raises as `field` does."""
    pairs = zip(camera.sub_imagers, poses(camera), strict=True)
    return max(field(camera, sub, pose) for sub, pose in pairs if sub.type == lens_type)


def _fault(k1: float, k2: float, limit: float) -> str:
    """Return why a distortion cannot be simulated up to r = `limit`, as part of a message; empty if it can."""
    turning = -3 * k1 / (10 * k2) if k2 > 0 else 0.0  # r^2 where the derivative, a parabola in r^2, is least
    squares = np.array([limit**2, min(max(turning, 0.0), limit**2)])
    if (1 + squares * (3 * k1 + squares * 5 * k2)).min() <= 0:
        return "folds (1 + 3 k1 r^2 + 5 k2 r^4 is not above 0 everywhere) the image of"
    radius = np.linspace(0, limit, 257)
    back, _ = undistort(distort(radius, 0.0, k1, k2, 1.0)[0], 0.0, k1, k2, 1.0, limit)
    error = np.abs(back - radius) * (1 + radius**2 * (3 * k1 + radius**2 * 5 * k2))
    return "" if float(error.max()) < LARGEST_ERROR * limit else "bends chief rays too strongly to follow them back to"
