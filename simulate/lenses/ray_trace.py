"""Exact ray tracing from a sensor point through the surfaces of a real lens.

Plain functions of coordinates; the arrays may be NumPy's or Dr.Jit's, see `Functions`. Lengths are millimetres, in the
coordinates of the lens: z grows towards the target, z = 0 is the plane of the lenses, where the front principal plane
lies, and the sensor is `depth` behind the rear principal plane. A surface is a conic of revolution,
c (x^2 + y^2 + (1 + k) z^2) = 2 z about its vertex, c its curvature and k its conic constant; a ray meets it and is
refracted there by Snell's law (G. H. Spencer, M. V. R. K. Murty, J. Opt. Soc. Am. 52, 672 (1962)). Every step is
relative to the vertex of its surface, so that float32 suffices.

Rays start on the sensor and go through points spread evenly over a disk, the exit pupil a little enlarged. The
irradiance of a sensor point before a uniform radiance L is then

    E = L (disk area / height^2) mean(cos^4 of the ray at the sensor, or 0 where it is blocked).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import poses

from .prescription import Prescription

WIDE = 1e15  # an opening that blocks nothing; its square is a float32
PER_SURFACE = 5
MARGIN = 1.02

Point = tuple[Any, Any]
Direction = tuple[Any, Any, Any]


class Functions(NamedTuple):
    """Functions that differ between NumPy and Dr.Jit."""

    sqrt: Callable[..., Any]
    where: Callable[..., Any]
    maximum: Callable[..., Any]


NUMPY = Functions(np.sqrt, np.where, np.maximum)


class Disk(NamedTuple):
    """Disk through which rays leave the sensor: its height before the rear principal plane, and its radius."""

    height: float
    radius: float


def path(prescription: Prescription, disk: Disk, surfaces: int = 0) -> FloatArray:
    """Return the numbers of a lens for `trace`, from the sensor to the target.

    First the disk's height and radius; then for every surface its distance from the previous one (for the first: from
    the disk), its curvature (positive if the centre lies towards the target), 1 + conic, the index on the sensor's side
    over that on the target's, and the square of its semi-diameter; at last the plane of the lenses, which changes
    nothing. Paths of fewer `surfaces` are filled up with such planes, so that paths of several lenses fit one table.
    """
    vertices = prescription.front_principal - prescription.vertices[::-1]
    start = prescription.front_principal - prescription.rear_principal + disk.height
    rows = np.column_stack(
        [
            np.diff(vertices, prepend=start),
            -1 / prescription.radius[::-1],
            1 + prescription.conic[::-1],
            (prescription.index / prescription.index_before)[::-1],
            prescription.semi_diameter[::-1] ** 2,
        ]
    )
    fill = max(surfaces - len(rows), 0) + 1
    planes = np.tile([0.0, 0.0, 1.0, 1.0, WIDE**2], (fill, 1))
    planes[0, 0] = -vertices[-1]
    return np.concatenate([[disk.height, disk.radius], rows.ravel(), planes.ravel()])


def trace(
    numbers: Sequence[Any] | FloatArray,
    x: Any,
    y: Any,
    across: Any,
    down: Any,
    depth: Any,
    functions: Functions = NUMPY,
) -> tuple[Point, Direction, Any]:
    """Trace the ray from the sensor point (x, y), `depth` behind the rear principal plane, out to the target.

    numbers : of `path`, each a number or an array, such as the entries of a table for the ray's lens type
    across, down : point of the unit disk through which the ray leaves

    Returns (x, y) where it crosses z = 0, its direction, of length 1 and with z > 0, and its weight: cos^4 of its angle
    at the sensor, 0 if it is blocked by a rim or by total reflection; then the direction is the axis.
    """
    along = depth + numbers[0]
    at_x, at_y = across * numbers[1], down * numbers[1]
    u, v = (at_x - x) / along, (at_y - y) / along
    cosine = 1 / functions.sqrt(1 + u * u + v * v)
    point, direction, passed = through(
        numbers[2:], (at_x, at_y), (u * cosine, v * cosine, cosine), functions, along > 0
    )
    return point, direction, functions.where(passed, (cosine * cosine) * (cosine * cosine), 0.0)


def through(
    numbers: Sequence[Any] | FloatArray, point: Point, direction: Direction, functions: Functions, passed: Any
) -> tuple[Point, Direction, Any]:
    """Trace a ray that crosses a plane at `point` through surfaces, whose numbers are those of `path`.

    Returns (x, y) in the last plane, the direction of length 1, and True if it got there; else the axis and False.
    """
    (x, y), z = point, 0.0
    for first in range(0, len(numbers), PER_SURFACE):
        step, *surface = numbers[first : first + PER_SURFACE]
        run = (step - z) / direction[2]
        x, y = x + run * direction[0], y + run * direction[1]
        (x, y, z), direction, passed = _refract(surface, x, y, direction, functions, passed)
    return (x, y), direction, passed


def _refract(
    surface: Sequence[Any], x: Any, y: Any, direction: Direction, functions: Functions, passed: Any
) -> tuple[Direction, Direction, Any]:
    """Refract a ray that crosses the vertex plane at (x, y): where it meets the surface, and its new direction."""
    curvature, shape, ratio, opening = surface
    where, root = functions.where, functions.sqrt
    u, v, w = direction
    # a t^2 - 2 b t + c = 0; in this form the nearer root loses no digit, and a plane is no special case
    a = curvature * (u * u + v * v + shape * w * w)
    b = w - curvature * (x * u + y * v)
    c = curvature * (x * x + y * y)
    square = b * b - a * c
    cosine = root(functions.maximum(square, 0.0))
    passed = passed & (square > 0) & (b + cosine > 0)
    run = where(passed, c / where(passed, b + cosine, 1.0), 0.0)
    x, y, z = x + run * u, y + run * v, run * w
    normal_x, normal_y, normal_z = -curvature * x, -curvature * y, 1 - curvature * shape * z
    length = root(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
    cosine = cosine / where(passed, length, 1.0)
    square = 1 - ratio * ratio * (1 - cosine * cosine)  # below 0: total reflection
    passed = passed & (x * x + y * y <= opening) & (square > 0) & (normal_z > 0)
    turn = (root(functions.maximum(square, 0.0)) - ratio * cosine) / where(passed, length, 1.0)
    u, v, w = ratio * u + turn * normal_x, ratio * v + turn * normal_y, ratio * w + turn * normal_z
    passed = passed & (w > 0)
    unit = 1 / root(where(passed, u * u + v * v + w * w, 1.0))
    x, y, z = (where(passed, value, 0.0) for value in (x, y, z))
    return (x, y, z), (where(passed, u * unit, 0.0), where(passed, v * unit, 0.0), where(passed, w * unit, 1.0)), passed


def exit_disk(prescription: Prescription, depth: float | Sequence[float], field: float) -> Disk:
    """Return a disk crossed by all unblocked rays from sensor points up to `field` off the axis, at given depths.

    It lies in the plane of the exit pupil or, where that is behind the sensor, far away or wasteful, at the last
    surface. Its radius is determined by traced rays, aberrations included, with a margin of two per cent. Raises
    InputError if the lens passes no light.
    """
    depths = np.atleast_1d(np.asarray(depth, dtype=np.float64))
    rear = prescription.rear_principal - float(prescription.vertices[-1])
    pupil = prescription.rear_principal - prescription.exit_pupil.position
    near = depths.min() + rear
    heights = [pupil, rear] if near / 5 < depths.min() + pupil < near * 20 else [rear]
    disks = [_disk(prescription, depths, field, rear, height) for height in heights]
    return min(disks, key=lambda disk: disk.radius / (depths.min() + disk.height))


def _disk(prescription: Prescription, depths: FloatArray, field: float, rear: float, height: float) -> Disk:
    """Return the disk at one height; `rear` is that of the last surface."""
    # No unblocked ray misses the last surface, wherever within its edge it meets that.
    sag = min(0.0, float(prescription.sag(np.inf)[-1])), max(0.0, float(prescription.sag(np.inf)[-1]))
    grow = np.array([(depths + height) / (depths + rear - edge) for edge in sag])
    radius = float(np.max(prescription.semi_diameter[-1] * grow + field * np.abs(grow - 1)))
    rings, turns = np.arange(1, 65) / 64, np.linspace(-pi / 2, pi / 2, 25)  # the other half is its mirror image
    across, down = rings[:, None] * np.cos(turns), rings[:, None] * np.sin(turns)
    points = np.linspace(0, field, 7)
    while True:
        numbers = path(prescription, Disk(height, radius))
        weight = trace(numbers, 0.0, points[:, None, None, None], across, down, depths[:, None, None])[2]
        lit = np.flatnonzero((weight > 0).any(axis=(0, 1, 3)))
        if not lit.size and radius < 1e-3 * prescription.semi_diameter[-1]:
            raise InputError("no light comes through the lens; widen its openings, or check its radii and thicknesses")
        last = int(lit[-1]) + 2 if lit.size else 1  # rings; the edge lies between the last one lit and the next
        radius *= min(last / 64, 1.0)
        if last > 48:
            return Disk(height, radius * MARGIN)


def reach(camera: Camera, lens_type: LensType) -> tuple[float, float, float]:
    """Return the largest distance of a lens type's sensor points from the axis, and their least and largest depth."""
    half = np.array(lens_type.pixels[::-1]) / 2 * camera.pixel_pitch
    corners = (half * [[1, 1], [1, -1], [-1, 1], [-1, -1]]).T
    pairs = zip(camera.sub_imagers, poses(camera), strict=True)
    points = np.array([pose.middle[:, None] + pose.axes @ corners for sub, pose in pairs if sub.type == lens_type])
    far = np.hypot(points[:, 0], points[:, 1]).max()
    return float(far), float(-points[:, 2].max()), float(-points[:, 2].min())


def exit_disk_of(camera: Camera, lens_type: LensType, prescription: Prescription) -> Disk:
    """Return the exit disk for every sensor point of a lens type."""
    field, least, largest = reach(camera, lens_type)
    return exit_disk(prescription, sorted({least, largest}), field)


def spread(count: int) -> tuple[FloatArray, FloatArray]:
    """Return points evenly spread over the unit disk, on Vogel's spiral."""
    number = np.arange(count) + 0.5
    radius, angle = np.sqrt(number / count), number * pi * (3 - 5**0.5)
    return radius * np.cos(angle), radius * np.sin(angle)
