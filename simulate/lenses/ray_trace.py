"""Exact rays from a sensor point through the surfaces of a real lens.

Plain functions of coordinates; the arrays may be NumPy's or Dr.Jit's (`Functions` says which). Lengths are millimetres,
in the coordinates of the lens: z grows towards the target, z = 0 is the plane of the lenses, where the front principal
plane lies, and the sensor stands `depth` behind the rear principal plane. A surface is a conic of revolution,
c (x^2 + y^2 + (1 + k) z^2) = 2 z about its vertex, c its curvature and k its conic constant; a ray meets it and is
refracted there by Snell's law (G. H. Spencer, M. V. R. K. Murty, J. Opt. Soc. Am. 52, 672 (1962)). Every step is
relative to the vertex at hand, so that float32 holds.

Rays start on the sensor and go through points spread evenly over a disk, the exit pupil a little enlarged. The
irradiance of a sensor point before a uniform radiance L is then

    E = L (disk area / height^2) mean(cos^4 of the ray at the sensor, or 0 where it is blocked).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import poses

from .prescription import Prescription

Array = NDArray[np.float64]
WIDE = 1e15  # an opening that blocks nothing; its square is a float32
PER_SURFACE = 5
MARGIN = 1.02


class Functions(NamedTuple):
    """What differs between NumPy and Dr.Jit."""

    sqrt: Callable[..., Any]
    where: Callable[..., Any]
    maximum: Callable[..., Any]


NUMPY = Functions(np.sqrt, np.where, np.maximum)


class Disk(NamedTuple):
    """Where rays are sent from the sensor: so far before the rear principal plane, and its radius."""

    height: float
    radius: float


def path(prescription: Prescription, disk: Disk, surfaces: int = 0) -> Array:
    """The numbers that `trace` goes by, from the sensor to the target.

    First the disk's height and radius; then for every surface its distance from the one before (of the first: from the
    disk), its curvature (positive where the centre lies towards the target), 1 + conic, the index on the sensor's side
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
    numbers: Sequence[Any] | Array, x: Any, y: Any, across: Any, down: Any, depth: Any, functions: Functions = NUMPY
) -> tuple[tuple[Any, Any], tuple[Any, Any, Any], Any]:
    """The ray from the sensor point (x, y), `depth` behind the rear principal plane, out to the target.

    numbers : of `path`, each a number or an array, such as what a table holds for the ray's lens type
    across, down : point of the unit disk through which it is sent

    Returns (x, y) where it crosses z = 0, its direction, of length 1 and with z > 0, and its weight: cos^4 of its angle
    at the sensor, 0 where a rim or total reflection stops it; then the rest is the axis.
    """
    along = depth + numbers[0]
    at_x, at_y = across * numbers[1], down * numbers[1]
    u, v = (at_x - x) / along, (at_y - y) / along
    cosine = 1 / functions.sqrt(1 + u * u + v * v)
    place, direction, passed = through(
        numbers[2:], (at_x, at_y), (u * cosine, v * cosine, cosine), functions, along > 0
    )
    return place, direction, functions.where(passed, (cosine * cosine) * (cosine * cosine), 0.0)


def through(
    numbers: Sequence[Any] | Array,
    place: tuple[Any, Any],
    direction: tuple[Any, Any, Any],
    functions: Functions,
    passed: Any,
) -> tuple[tuple[Any, Any], tuple[Any, Any, Any], Any]:
    """A ray that crosses a plane at (x, y), through the surfaces; their numbers are those of `path`.

    Returns (x, y) in the last plane, the direction of length 1, and whether it got there; where not, the axis.
    """
    (x, y), z = place, 0.0
    for first in range(0, len(numbers), PER_SURFACE):
        step, *surface = numbers[first : first + PER_SURFACE]
        run = (step - z) / direction[2]
        x, y = x + run * direction[0], y + run * direction[1]
        (x, y, z), direction, passed = _refract(surface, x, y, direction, functions, passed)
    return (x, y), direction, passed


def _refract(
    surface: Sequence[Any], x: Any, y: Any, direction: tuple[Any, Any, Any], functions: Functions, passed: Any
) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any], Any]:
    """Where a ray that crosses the vertex plane at (x, y) meets a surface, from the vertex, and how it goes on."""
    curvature, shape, ratio, opening = surface
    where, root = functions.where, functions.sqrt
    u, v, w = direction
    # a t^2 - 2 b t + c = 0; written so, the nearer root loses no digit, and a plane is no special case
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
    """The disk that holds every ray that passes from sensor points up to `field` off the axis, at one or more depths.

    It lies in the plane of the exit pupil or, where that is behind the sensor, far away or wasteful, at the last
    surface; traced rays say how wide it is, aberrations included, and it is two per cent wider. Raises InputError
    where no light comes through.
    """
    depths = np.atleast_1d(np.asarray(depth, dtype=np.float64))
    rear = prescription.rear_principal - float(prescription.vertices[-1])
    pupil = prescription.rear_principal - prescription.exit_pupil.position
    near = depths.min() + rear
    heights = [pupil, rear] if near / 5 < depths.min() + pupil < near * 20 else [rear]
    disks = [_disk(prescription, depths, field, rear, height) for height in heights]
    return min(disks, key=lambda disk: disk.radius / (depths.min() + disk.height))


def _disk(prescription: Prescription, depths: Array, field: float, rear: float, height: float) -> Disk:
    """The disk at one height; `rear` is that of the last surface."""
    # No ray that passes misses the last surface, wherever within its edge it meets that.
    sag = min(0.0, float(prescription.sag(np.inf)[-1])), max(0.0, float(prescription.sag(np.inf)[-1]))
    grow = np.array([(depths + height) / (depths + rear - one) for one in sag])
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


def reach(camera: Camera, kind: LensType) -> tuple[float, float, float]:
    """Of a lens type's sensor points: the farthest from its lens's axis, and the least and the largest depth."""
    half = np.array(kind.pixels[::-1]) / 2 * camera.pixel_pitch
    corners = (half * [[1, 1], [1, -1], [-1, 1], [-1, -1]]).T
    pairs = zip(camera.sub_imagers, poses(camera), strict=True)
    points = np.array([pose.middle[:, None] + pose.axes @ corners for sub, pose in pairs if sub.type == kind])
    far = np.hypot(points[:, 0], points[:, 1]).max()
    return float(far), float(-points[:, 2].max()), float(-points[:, 2].min())


def exit_disk_of(camera: Camera, kind: LensType, prescription: Prescription) -> Disk:
    """The disk that serves every sensor point of a lens type."""
    field, least, largest = reach(camera, kind)
    return exit_disk(prescription, sorted({least, largest}), field)


def spread(count: int) -> tuple[Array, Array]:
    """Points, evenly spread over the unit disk on Vogel's spiral."""
    number = np.arange(count) + 0.5
    radius, angle = np.sqrt(number / count), number * pi * (3 - 5**0.5)
    return radius * np.cos(angle), radius * np.sin(angle)
