"""Exact ray tracing from a sensor point through the surfaces of a real lens.

Plain functions of coordinates; the arrays may be NumPy's or Dr.Jit's, see `Functions`. Lengths are millimetres, in the
coordinates of the lens: z grows towards the target, z = 0 is the plane of the lenses, where the front principal plane
lies, and the sensor is `depth` behind the rear principal plane. A conic of revolution,
c (x^2 + y^2 + (1 + k) z^2) = 2 z, is met in closed form (G. H. Spencer, M. V. R. K. Murty, J. Opt. Soc. Am. 52, 672
(1962)). An even asphere adds a polynomial to its sag,

    z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a4 r^4 + a6 r^6 + ... + a16 r^16,

and is met by Newton's method along the ray, from the point of the conic. Rays are refracted by Snell's law. Every step
is relative to the vertex of its surface, so that float32 suffices.

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

from .prescription import Prescription

Direction = tuple[Any, Any, Any]

STEPS = 8  # of Newton's method; the error is squared by each
CONVERGED = 1e-5  # largest last step, in semi-diameters, above which a ray is blocked
LONGEST = 2.0  # step in semi-diameters, beyond which the method has failed
BEYOND = 4.0  # r^2 over that of the rim, where the polynomial ends; rays out there are blocked anyway
STEEPEST = 1e-3  # least cosine times length of the normal, with which Newton's method divides
WIDE = 1e15  # an opening that blocks nothing; its square is a float32
MARGIN = 1.02

Point = tuple[Any, Any]


class Functions(NamedTuple):
    """Functions that differ between NumPy and Dr.Jit."""

    sqrt: Callable[..., Any]
    where: Callable[..., Any]
    maximum: Callable[..., Any]


NUMPY = Functions(np.sqrt, np.where, np.maximum)


class Meeting(NamedTuple):
    """Where a ray meets a surface: distance along the ray, point, normal of any length with z > 0, their products.

    cosine : of the angle of incidence times the length of the normal;  passed : True if the ray meets the surface
    """

    run: Any
    point: Direction
    normal: Direction
    cosine: Any
    passed: Any


def meet_conic(
    curvature: Any, shape: Any, x: Any, y: Any, direction: Direction, functions: Functions, passed: Any
) -> Meeting:
    """Return where a ray that crosses the vertex plane at (x, y) meets a conic; `shape` is 1 + its conic constant."""
    u, v, w = direction
    # a t^2 - 2 b t + c = 0; in this form the nearer root loses no digit, and a plane is no special case
    a = curvature * (u * u + v * v + shape * w * w)
    b = w - curvature * (x * u + y * v)
    c = curvature * (x * x + y * y)
    square = b * b - a * c
    cosine = functions.sqrt(functions.maximum(square, 0.0))
    passed = passed & (square > 0) & (b + cosine > 0)
    run = functions.where(passed, c / functions.where(passed, b + cosine, 1.0), 0.0)
    x, y, z = x + run * u, y + run * v, run * w
    normal = -curvature * x, -curvature * y, 1 - curvature * shape * z
    return Meeting(run, (x, y, z), normal, cosine, passed & (normal[2] > 0))


def meet_asphere(
    surface: Sequence[Any], x: Any, y: Any, direction: Direction, functions: Functions, passed: Any
) -> Meeting:
    """Return where a ray that crosses the vertex plane at (x, y) meets an even asphere.

    surface : curvature, 1 + conic constant, square of the semi-diameter, and then the sag at the rim that each term of
        the polynomial, from r^4 on, adds
    """
    curvature, shape, opening, *terms = surface
    u, v, w = direction
    total, (x, y, z), *_ = meet_conic(curvature, shape, x, y, direction, functions, passed)
    step = total
    for _ in range(STEPS):
        sag, slope, _ = _sag(curvature, shape, opening, terms, x * x + y * y, functions)
        toward = w - 2 * slope * (x * u + y * v)
        step = (sag - z) / functions.where(toward > STEEPEST, toward, 1.0)
        run = functions.where(step * step < LONGEST**2 * opening, step, 0.0)
        total, x, y, z = total + run, x + run * u, y + run * v, z + run * w
    _, slope, exists = _sag(curvature, shape, opening, terms, x * x + y * y, functions)
    cosine = w - 2 * slope * (x * u + y * v)
    passed = passed & exists & (cosine > 0) & (step * step <= CONVERGED**2 * opening)
    return Meeting(total, (x, y, z), (-2 * slope * x, -2 * slope * y, 1.0), cosine, passed)


def _sag(
    curvature: Any, shape: Any, opening: Any, terms: Sequence[Any], square: Any, functions: Functions
) -> tuple[Any, Any, Any]:
    """Return the sag at r^2 = `square`, its derivative by r^2, and whether the conic reaches so far."""
    inner = 1 - shape * curvature * curvature * square
    exists = inner > 0
    root = functions.sqrt(functions.where(exists, inner, 1.0))
    share = square / opening
    share = functions.where(share < BEYOND, share, BEYOND)
    value, slope = 0.0 * share, 0.0 * share
    for term in reversed(terms):
        value, slope = value * share + term, slope * share + value
    sag = curvature * square / (1 + root) + share * share * value
    return sag, curvature / (2 * root) + (2 * share * value + share * share * slope) / opening, exists


class Disk(NamedTuple):
    """Disk through which rays leave the sensor: its height before the rear principal plane, and its radius."""

    height: float
    radius: float


class LensPath(NamedTuple):
    """The numbers of a lens for `trace`, from the sensor to the target.

    height, radius : of the disk
    rows : for every surface its distance from the previous one (for the first: from the disk), its curvature (positive
        if the centre lies towards the target), 1 + conic, the index on the sensor's side over that on the target's, the
        square of its semi-diameter, and for an even asphere the sag at the rim that each term, from r^4 on, adds; at
        last the plane of the lenses, which changes nothing
    """

    height: Any
    radius: Any
    rows: tuple[tuple[Any, ...], ...]

    def converted(self, convert: Callable[[float], Any]) -> LensPath:
        """Return the path with every number converted, such as to Dr.Jit's."""
        rows = tuple(tuple(convert(number) for number in row) for row in self.rows)
        return LensPath(convert(self.height), convert(self.radius), rows)


def path(prescription: Prescription, disk: Disk) -> LensPath:
    """Return the numbers of a lens for `trace`."""
    vertices = prescription.front_principal - prescription.vertices[::-1]
    start = prescription.front_principal - prescription.rear_principal + disk.height
    conics = np.column_stack(
        [
            np.diff(vertices, prepend=start),
            -1 / prescription.radius[::-1],
            1 + prescription.conic[::-1],
            (prescription.index / prescription.index_before)[::-1],
            prescription.semi_diameter[::-1] ** 2,
        ]
    )
    terms = [[-float(term) for term in row] for row in prescription.rim_sags()[::-1]]
    rows = [(*conic.tolist(), *row) for conic, row in zip(conics, terms, strict=True)]
    return LensPath(disk.height, disk.radius, (*rows, (-float(vertices[-1]), 0.0, 1.0, 1.0, WIDE**2)))


def trace(
    numbers: LensPath,
    x: Any,
    y: Any,
    across: Any,
    down: Any,
    depth: Any,
    functions: Functions = NUMPY,
) -> tuple[Point, Direction, Any, Any]:
    """Trace the ray from the sensor point (x, y), `depth` behind the rear principal plane, out to the target.

    across, down : point of the unit disk through which the ray leaves

    Returns (x, y) where it crosses z = 0, its direction, of length 1 and with z > 0, its weight, cos^4 of its angle at
    the sensor, and its optical path from the sensor point to z = 0, in mm. A ray that is blocked by a rim or by total
    reflection has the weight and the path 0 and the direction of the axis.
    The optical path is the sum of index times length, negative where a ray is followed backwards, such as from the
    plane of the last surface to the plane of the lenses behind it. Rays of one sensor point are perpendicular to the
    surfaces of equal path (Malus and Dupin): its gradient by the point in z = 0 is (u, v).
    """
    along = depth + numbers.height
    at_x, at_y = across * numbers.radius, down * numbers.radius
    u, v = (at_x - x) / along, (at_y - y) / along
    slant = functions.sqrt(1 + u * u + v * v)
    cosine = 1 / slant
    start = (at_x, at_y), (u * cosine, v * cosine, cosine)
    point, direction, passed, length = through(numbers.rows, *start, functions, along > 0, along * slant)
    weight = functions.where(passed, (cosine * cosine) * (cosine * cosine), 0.0)
    return point, direction, weight, functions.where(passed, length, 0.0)


def through(
    rows: Sequence[Sequence[Any]],
    point: Point,
    direction: Direction,
    functions: Functions,
    passed: Any,
    length: Any = 0.0,
) -> tuple[Point, Direction, Any, Any]:
    """Trace a ray that crosses a plane at `point` through surfaces, whose numbers are those of `LensPath.rows`.

    Returns (x, y) in the last plane, the direction of length 1, and True if it got there, else the axis and False; and
    the optical path, beyond the `length` that the ray begins with.
    """
    (x, y), z, index = point, 0.0, 1.0
    for distance, *surface in rows:
        run = (distance - z) / direction[2]
        x, y = x + run * direction[0], y + run * direction[1]
        curvature, shape, ratio, opening, *terms = surface
        if terms:
            meeting = meet_asphere((curvature, shape, opening, *terms), x, y, direction, functions, passed)
        else:
            meeting = meet_conic(curvature, shape, x, y, direction, functions, passed)
        (x, y, z), direction, passed = _refract(meeting, ratio, opening, direction, functions)
        length = length + index * (run + meeting.run)
        index = index / ratio
    return (x, y), direction, passed, length


def _refract(
    meeting: Meeting, ratio: Any, opening: Any, direction: Direction, functions: Functions
) -> tuple[Direction, Direction, Any]:
    """Refract a ray where it meets a surface: return the point, the new direction, and whether it passes."""
    where, root = functions.where, functions.sqrt
    (x, y, z), (normal_x, normal_y, normal_z), passed = meeting.point, meeting.normal, meeting.passed
    u, v, w = direction
    length = root(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
    cosine = meeting.cosine / where(passed, length, 1.0)
    square = 1 - ratio * ratio * (1 - cosine * cosine)  # below 0: total reflection
    passed = passed & (x * x + y * y <= opening) & (square > 0)
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
    grow = np.array([(depths + height) / (depths + rear - edge) for edge in prescription.last_extent()])
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


def spread(count: int) -> tuple[FloatArray, FloatArray]:
    """Return points evenly spread over the unit disk, on Vogel's spiral."""
    number = np.arange(count) + 0.5
    radius, angle = np.sqrt(number / count), number * pi * (3 - 5**0.5)
    return radius * np.cos(angle), radius * np.sin(angle)
