"""The wave that a sensor point sends back through a lens to the target.

By reciprocity, the response of a sensor point to the point t of the target is |U(t)|^2, U the field at t of a point
source on the sensor. Rays carry that field to the entrance pupil, where the stop's rim is as the target sees it: a ray
that leaves through the point a of the exit disk with the weight w(a) has there the position x(a) and the optical path
L(a). About the point t0 that the rays meet on average (Fraunhofer's approximation, exact in defocus and aberrations),

    U(t) = integral over a of sqrt(w |dq/da|) exp(2 pi i / lambda (L + |x - t0| - q . (t - t0))),

    q = (x - t0) / |x - t0|.

The nodes of the integral are polar: by direction from the middle of the clear part of the exit disk, whose edge is
found by dividing intervals along each direction, and by Gauss-Legendre along the radius, so that a vignetted pupil has
a sharp edge. Lengths are millimetres, in the coordinates of the lens: sensor points lie on the y axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import ceil, pi, sqrt

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from .prescription import Prescription
from .ray_trace import Disk, LensPath, path, spread, trace

SCOUTS = 4096  # rays that find the middle of the clear part of the disk
EDGE_STEPS, PARTS = 8, 16  # of the search for the edge, each of which divides an interval into so many parts
STEP = 1e-6  # of differences, relative to the disk
BESIDE_RIM = 1.001  # rims are so much wider for rays that the differences trace
RAY_NODES = (48, 96)  # along the radius and around, where no wave oscillates over the pupil
GOLDEN = (sqrt(5) - 1) / 2
MOST_OSCILLATIONS = 600.0  # over the radius of the spot, of what rays resolve
FEWEST = (16, 32)
MOST_NODES = 2**22
GRID_REACH = 40.0  # in units of `resolution`: a grid of a point-spread function extends so far beyond the spot of rays


@dataclass(frozen=True, eq=False)
class Wavefront:
    """The wave of one sensor point at one wavelength, at n nodes of the pupil.

    wavelength : None for light without one
    cosines : (2, n) direction cosines of the lines from `centre` on the target to the nodes
    path : (n,) optical path from the sensor point through the node to `centre`, relative to the mean path
    light : (n,) share of the light that each node carries; the sum is `solid_angle`'s share 1
    density : (n,) |dq/da| times the node's area, so that a field's amplitude is sqrt(light * density); (0,) for rays
    hits : (2, n) where the ray of each node meets the target, from `centre`
    centre : (x, y) of the target that the rays meet on average
    brightness : light of the sensor point, projected solid angle in sr
    outermost : radius of the outermost nodes, 1 the edge of the pupil
    """

    wavelength: float | None
    cosines: FloatArray
    path: FloatArray
    light: FloatArray
    density: FloatArray
    hits: FloatArray
    centre: tuple[float, float]
    brightness: float
    outermost: float

    @cached_property
    def amplitude(self) -> FloatArray:
        """Amplitude of each node's wave, (n,); the light over the whole target plane is wavelength^2."""
        return np.sqrt(self.light * self.density)

    @cached_property
    def middle(self) -> FloatArray:
        """Middle of the range of direction cosines: (2,)."""
        return (self.cosines.max(axis=1) + self.cosines.min(axis=1)) / 2

    @cached_property
    def half_width(self) -> float:
        """Half of the largest range of direction cosines; |U|^2 has frequencies up to twice that / wavelength."""
        return float(np.ptp(self.cosines, axis=1).max() / 2 / self.outermost)

    @cached_property
    def spot_radius(self) -> float:
        """Largest distance of a ray from the centre, on the target."""
        return float(np.hypot(*self.hits).max())

    @property
    def resolution(self) -> float:
        """Wavelength times the f-number on the target's side: 1 over the cut-off frequency of the MTF."""
        return 0.0 if self.wavelength is None else self.wavelength / (2 * self.half_width)

    @property
    def extent(self) -> float:
        """Half the width of the grid that its point-spread function needs."""
        return self.spot_radius + GRID_REACH * self.resolution

    def turned(self, angle: float) -> Wavefront:
        """Return the wave of a sensor point that is turned about the axis, from y towards -x."""
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        x, y = turn @ np.array(self.centre)
        return replace(self, cosines=turn @ self.cosines, hits=turn @ self.hits, centre=(float(x), float(y)))


def node_counts(half_width: float, spot: float, half: float) -> tuple[int, int]:
    """Return the numbers of nodes along the radius and around with which a field is exact on a square about its centre.

    half_width : of the direction cosines, over the wavelength;  spot : radius of the rays;  half : of the square's side
    Over a radius the phase spans 2 pi half_width times the distance between a ray and a corner of the square.
    Gauss-Legendre integrates exp(i phase u), 0 < u < 1, to rounding from phase / 4 nodes plus a few, and the sum over n
    directions leaves the Bessel function J_n(phase), which vanishes from n = phase plus a few.
    """
    phase = 2 * pi * half_width * (spot + sqrt(2) * half)
    counts = FEWEST[0] + ceil(0.27 * phase), 4 * ceil((FEWEST[1] + 1.05 * phase) / 4)  # the axes among them
    if counts[0] * counts[1] > MOST_NODES:
        raise InputError(
            f"the wave oscillates {phase / (2 * pi):.3g} times over the radius of the pupil, more than can be computed;"
            ' use camera.wavelength = "none", as diffraction is negligible'
        )
    return counts


@lru_cache(maxsize=16)
def polar_nodes(counts: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return radius, (r, 1), and angle, (1, n), of the nodes of the unit disk and their areas, (r, 1)."""
    nodes, weights = np.polynomial.legendre.leggauss(counts[0])
    radius = (nodes[:, None] + 1) / 2
    angle = 2 * pi * np.arange(counts[1])[None, :] / counts[1]
    return radius, angle, weights[:, None] / 2 * radius * (2 * pi / counts[1])


def thin_wavefront(
    aperture: float,
    depth: float,
    height: float,
    distance: float,
    focus: float,
    wavelength: float | None,
    half: float = 0.0,
    finest: float | None = None,
) -> Wavefront:
    """Return the wave of the sensor point (0, height) behind a thin lens that is focused at `focus`.

    distance, half : as of `wavefront_of`;  finest : shortest period on the target that rays alone resolve
    """
    spot, counts = aperture / 2 * abs(1 - distance / focus), RAY_NODES
    if finest is not None:
        counts = node_counts(1.0, min(spot / finest, MOST_OSCILLATIONS), 0.0)
    if wavelength is not None:
        unit = wavelength * abs(distance) / aperture
        counts = node_counts(0.5 / unit, spot, max(half, spot + GRID_REACH * unit))
    radius, angle, area = polar_nodes(counts)
    if wavelength is None:
        angle = angle + 2 * pi / counts[1] * ((GOLDEN * np.arange(counts[0])[:, None]) % 1)
    at = aperture / 2 * (radius * np.stack([np.cos(angle), np.sin(angle)])).reshape(2, -1)
    share = np.broadcast_to(area, counts).ravel() * (aperture / 2) ** 2
    light = share / (1 + (at[0] ** 2 + (at[1] - height) ** 2) / depth**2) ** 2
    brightness = float(light.sum()) / depth**2
    light /= light.sum()
    hits = at * (1 - distance / focus)
    middle = hits @ light  # from the chief ray: the side of the lens that is nearer to the sensor point is brighter
    path = np.square(at).sum(axis=0) / 2 * (1 / distance - 1 / focus) - middle @ at / distance
    return Wavefront(
        wavelength=wavelength,
        cosines=at / distance,
        path=path - light @ path,
        light=light,
        density=np.zeros(0) if wavelength is None else share / distance**2,
        hits=hits - middle[:, None],
        centre=(float(middle[0]), float(middle[1]) - height * distance / depth),
        brightness=brightness,
        outermost=float(radius[-1, 0]),
    )


def wavefront_of(
    prescription: Prescription,
    disk: Disk,
    depth: float,
    height: float,
    distance: float,
    wavelength: float | None,
    half: float = 0.0,
) -> Wavefront | None:
    """Trace the wave of the sensor point (0, height), `depth` behind the rear principal plane, to the target.

    distance : of the target; negative for the virtual point behind the lens from which divergent light comes
    half : of the side of a square about the centre in which the field is exact, at least `Wavefront.extent`
    Returns None if no light passes.
    """
    middle = _middle(prescription, disk, depth, height)
    if middle is None:
        return None
    pencil = _Pencil(prescription, disk, depth, height, distance, middle)
    rays = replace(_traced(pencil, None, RAY_NODES), wavelength=wavelength)
    if wavelength is None:
        return rays
    counts = node_counts(rays.half_width / wavelength, rays.spot_radius, max(half, rays.extent))
    return _traced(pencil, wavelength, counts)


@dataclass(frozen=True)
class _Pencil:
    """The light of a sensor point, (0, height), as `wavefront_of` takes it; middle : on the exit disk, of its area."""

    prescription: Prescription
    disk: Disk
    depth: float
    height: float
    distance: float
    middle: FloatArray


def _middle(prescription: Prescription, disk: Disk, depth: float, height: float) -> FloatArray | None:
    """Return the middle of the light on the exit disk, as a point of the unit disk, or None if there is none."""
    points = np.array(spread(SCOUTS))
    weight: FloatArray = trace(path(prescription, disk), 0.0, height, points[0], points[1], depth)[2]
    total = float(weight.sum())
    return points @ weight / total if total > 0 else None


def _traced(pencil: _Pencil, wavelength: float | None, counts: tuple[int, int]) -> Wavefront:
    prescription, disk, depth, height = pencil.prescription, pencil.disk, pencil.depth, pencil.height
    distance, middle = pencil.distance, pencil.middle
    radius, angle, area = polar_nodes(counts)
    direction = np.stack([np.cos(angle), np.sin(angle)])
    edge = _edge(pencil, direction[:, 0])
    at = (middle[:, None, None] + radius * edge * direction).reshape(2, -1)
    # All nodes are known to pass the rims; the differences may step over these.
    open_lens = replace(prescription, semi_diameter=BESIDE_RIM * prescription.semi_diameter)
    numbers = path(open_lens, disk)
    points, (u, v, w), weights, optical = trace(numbers, 0.0, height, at[0], at[1], depth)
    slopes = np.stack([u / w, v / w])
    hits = np.stack(points) + distance * slopes
    before = _pupil_plane(prescription, distance)
    light = weights * (area * edge**2).ravel()
    brightness = float(light.sum()) * (disk.radius / (depth + disk.height)) ** 2
    light /= light.sum()
    centre = hits @ light

    def lines(points: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return direction cosines and lengths of the lines from the centre to the pupil."""
        beside = points + before * slopes - centre.reshape(2, *[1] * (points.ndim - 1))
        length = np.copysign(np.sqrt(np.square(beside).sum(axis=0) + (distance - before) ** 2), distance)
        return beside / length, length

    cosines, length = lines(np.stack(points), slopes)
    density = np.zeros(0)
    if wavelength is not None:
        steps = STEP * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[..., None]
        moved = lines(*_rays(numbers, height, at + steps, depth))[0]
        right, up = (moved[:, 0] - moved[:, 1]) / (2 * STEP), (moved[:, 2] - moved[:, 3]) / (2 * STEP)
        density = np.abs(right[0] * up[1] - right[1] * up[0]) * (area * edge**2).ravel()
    optical = optical + before * np.sqrt(1 + np.square(slopes).sum(axis=0)) + length
    return Wavefront(
        wavelength=wavelength,
        cosines=cosines,
        path=optical - light @ optical,
        light=light,
        density=density,
        hits=hits - centre[:, None],
        centre=(float(centre[0]), float(centre[1])),
        brightness=brightness,
        outermost=float(radius[-1, 0]),
    )


def _pupil_plane(prescription: Prescription, distance: float) -> float:
    """Return how far before the plane of the lenses the entrance pupil is, 0 if it is not near the lens.

    From the plane of the lenses itself, the rim would be where aberrations displace it on the way back from the stop.
    """
    before = prescription.front_principal - prescription.entrance_pupil.position
    return before if abs(before) < abs(distance) / 2 else 0.0


def _rays(numbers: LensPath, height: float, at: FloatArray, depth: float) -> tuple[FloatArray, FloatArray]:
    """Trace rays through points of the disk, (k, 2, n): points and slopes, (2, k, n)."""
    (x, y), (u, v, w), _, _ = trace(numbers, 0.0, height, at[:, 0], at[:, 1], depth)
    return np.stack([x, y]), np.stack([u / w, v / w])


def _edge(pencil: _Pencil, direction: FloatArray) -> FloatArray:
    """Return the distance from the middle to the edge of the light along directions, (2, n): (1, n)."""
    numbers = path(pencil.prescription, pencil.disk)
    low, width = np.zeros(direction.shape[1]), 2.0  # across the unit disk, wherever the middle lies
    for _ in range(EDGE_STEPS):
        width /= PARTS
        tried = low + width * np.arange(1, PARTS)[:, None]
        at = pencil.middle[:, None, None] + tried * direction[:, None]
        lit = trace(numbers, 0.0, pencil.height, at[0], at[1], pencil.depth)[2] > 0
        low = low + width * np.logical_and.accumulate(lit).sum(axis=0)
    return low[None, :]
