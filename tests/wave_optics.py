"""Wave optics of a lens of conics and aspheres without code of the program: direct sums over the aperture stop.

The stop is the first surface. Rays of a sensor point are aimed, by Newton's method, at the nodes of a quadrature over
the stop; from there the field goes to points of the target by a Rayleigh-Sommerfeld sum with true distances.
Lengths are millimetres; z grows from the target to the sensor, and is 0 at the first surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.scenes.optics.prescription import Prescription

STEP = 1e-6  # of differences of slopes


@dataclass(frozen=True)
class Aperture:
    """The field of a sensor point on the stop: points (3, n), optical paths and strengths."""

    points: np.ndarray
    paths: np.ndarray
    strengths: np.ndarray


def _traced(lens: Prescription, height: float, sensor: float, slopes: np.ndarray) -> tuple[np.ndarray, ...]:
    """Trace rays from (0, height, sensor) to the first surface: points on it, directions behind it, optical paths."""
    direction = np.stack([slopes[0], slopes[1], -1 + 0 * slopes[0]])
    direction = direction / np.sqrt((direction**2).sum(axis=0))
    point = np.array([[0.0], [height], [sensor]]) + 0 * direction
    path = 0 * slopes[0]
    vertices = np.append(0.0, np.cumsum(lens.thickness[:-1]))
    indices = np.append(1.0, lens.index)
    for number in reversed(range(lens.radius.size)):
        run = (vertices[number] - point[2]) / direction[2]
        for _ in range(12):  # Newton's method, from the plane of the vertex
            x, y, z = point + run * direction
            sag, slope = _sag(lens, number, x * x + y * y)
            normal = np.stack([2 * slope * x, 2 * slope * y, -np.ones_like(x)])
            run = run - (sag - (z - vertices[number])) / (normal * direction).sum(axis=0)
        point = point + run * direction
        _, slope = _sag(lens, number, point[0] ** 2 + point[1] ** 2)
        normal = np.stack([2 * slope * point[0], 2 * slope * point[1], -np.ones_like(slope)])
        normal = normal * np.sign((normal * direction).sum(axis=0)) / np.sqrt((normal**2).sum(axis=0))
        path = path + indices[number + 1] * run
        ratio, cosine = indices[number + 1] / indices[number], (normal * direction).sum(axis=0)
        direction = ratio * direction + (np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal
    return point, direction, path


def _sag(lens: Prescription, number: int, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sag of a surface at squared heights, and its derivative by these."""
    bend, conic = 1 / lens.radius[number], lens.conic[number]
    root = np.sqrt(1 - (1 + conic) * bend**2 * square)
    terms = np.polynomial.Polynomial([0.0, 0.0, *(lens.aspheric[number] if lens.aspheric else ())])
    return bend * square / (1 + root) + terms(square), bend / (2 * root) + terms.deriv()(square)


def aperture_of(lens: Prescription, depth: float, height: float, rings: int = 40, turns: int = 80) -> Aperture:
    """Return the field on the stop of the sensor point (0, height), `depth` behind the rear principal plane."""
    sensor, rim = lens.rear_principal + depth, lens.semi_diameter[0]
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radius, angle = np.sqrt((nodes[:, None] + 1) / 2), 2 * np.pi * (np.arange(turns) + 0.5) / turns
    wanted = rim * np.stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])
    area = np.repeat(weights / 2, turns) * np.pi * rim**2 / turns
    slopes = (wanted - np.array([[0.0], [height]])) / sensor
    grown = np.ones_like(area)
    for _ in range(8):
        found = _traced(lens, height, sensor, slopes)[0][:2]
        columns = [(_traced(lens, height, sensor, slopes + step)[0][:2] - found) / STEP for step in _STEPS]
        grown = columns[0][0] * columns[1][1] - columns[0][1] * columns[1][0]
        (x, y), (right, up) = wanted - found, columns
        slopes = slopes + np.stack([x * up[1] - y * up[0], y * right[0] - x * right[1]]) / grown
    point, direction, path = _traced(lens, height, sensor, slopes)
    assert np.abs(point[:2] - wanted).max() < 1e-9
    tilt = 2 * _sag(lens, 0, point[0] ** 2 + point[1] ** 2)[1] * point[:2]
    through = np.abs(direction[2] - (tilt * direction[:2]).sum(axis=0))  # light's cosine times surface per area
    light = 1 / (1 + (slopes**2).sum(axis=0)) ** 2 / np.abs(grown) * area
    return Aperture(point, path, np.sqrt(light * through * area))


_STEPS = STEP * np.array([[[1.0], [0.0]], [[0.0], [1.0]]])


def _distances(
    lens: Prescription, distance: float, aperture: Aperture, height: float, aside: float = 0.0
) -> np.ndarray:
    target = np.array([[aside], [height], [lens.front_principal - distance]])
    return np.sqrt(((aperture.points - target) ** 2).sum(axis=0))


def relative_light(
    lens: Prescription, distance: float, aperture: Aperture, heights: np.ndarray, wavelength: float, aside: float = 0.0
) -> np.ndarray:
    """Return |field|^2 at points (aside, height) of the target, 1 if all waves arrived there in phase."""
    found: list[float] = []
    for height in heights:
        away = _distances(lens, distance, aperture, height, aside)
        path = aperture.paths + away
        wave = aperture.strengths / away * np.exp(2j * np.pi / wavelength * (path - path[0]))
        found.append(abs(wave.sum()) ** 2 / (aperture.strengths / away).sum() ** 2)
    return np.array(found)
