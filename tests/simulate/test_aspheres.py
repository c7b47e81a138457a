"""Even aspheres against other descriptions of the same surface, and two other ray tracers.

Rays are those of the ray tracers (`oracle_rays`) to 1e-10. Light runs from the object to the image there; so the lens
is turned round here, and its sensor is the object.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.optics.field import prescription_of
from ommatid.scenes.optics.prescription import Prescription, prescribe
from ommatid.scenes.optics.ray_trace import (
    NUMPY,
    Disk,
    exit_disk,
    meet_asphere,
    path,
    spread,
    trace,
)

from ..lenses import BICONVEX, camera_with, lens, turned_round
from .oracle_rays import HEIGHTS, WAVELENGTH, pupil_points
from .zemax_lenses import OBJECT, PUPIL, ROWS, zmx

Array = NDArray[np.float64]


def same(first: Any, second: Any, tolerance: float) -> None:
    for one, other in zip((*first[0], *first[1], *first[2:]), (*second[0], *second[1], *second[2:]), strict=True):
        np.testing.assert_allclose(one, other, atol=tolerance)


def height(surface: tuple[float, ...], square: Array) -> Array:
    """Return the sag of (curvature, 1 + conic, a4, a6, ...)."""
    curvature, shape, *terms = surface
    root = np.sqrt(np.maximum(1 - shape * curvature**2 * square, 0))
    return curvature * square / (1 + root) + sum(term * square ** (2 + n) for n, term in enumerate(terms))


@pytest.mark.parametrize("seed", range(4))
def test_strong_aspheres_are_met_where_bisection_finds_them(seed: int) -> None:
    """Waves of a third of the semi-diameter, such as telephones' lenses have; rays that meet them once; no warning."""
    rng = np.random.default_rng(seed)
    surface = (rng.uniform(-0.6, 0.6), rng.uniform(-2, 2), *(rng.normal(size=7) * 0.15 * np.exp(-0.3 * np.arange(7))))
    x, y, p, q = rng.uniform(-1, 1, (4, 300)) * [[0.9], [0.9], [0.45], [0.45]]

    def above(z: Array) -> Array:
        return z - height(surface, (x + p * z) ** 2 + (y + q * z) ** 2)

    grid = np.linspace(-0.8, 0.8, 801)
    sides = above(np.repeat(grid[:, None], 300, axis=1)) > 0
    once = np.sum(sides[1:] != sides[:-1], axis=0) == 1
    low, high = (grid[np.argmax(sides, axis=0) + step] for step in (-1, 0))
    for _ in range(50):
        middle = (low + high) / 2
        low, high = np.where(above(middle) > 0, low, middle), np.where(above(middle) > 0, middle, high)
    square = (x + p * high) ** 2 + (y + q * high) ** 2
    once &= ~sides[0] & (square < 0.99) & (1 - surface[1] * surface[0] ** 2 * square > 0.02)
    one = lens([1 / surface[0]], [], [1.5], 1.0, [surface[1] - 1])
    for at in (0.2, 0.5):
        assert replace(one, aspheric=(surface[2:],)).sag(at)[0] == pytest.approx(height(surface, np.array([at**2]))[0])
    w = 1 / np.sqrt(1 + p * p + q * q)
    row = (*surface[:2], 1.0, *surface[2:])
    with np.errstate(all="raise"):
        meeting = meet_asphere(row, x, y, (p * w, q * w, w), NUMPY, np.full(300, True))
    assert np.mean(once) > 0.3
    assert np.all(meeting.passed[once])
    np.testing.assert_allclose(meeting.point[2][once], high[once], atol=1e-12)


def test_scaling_a_lens_scales_its_polynomial() -> None:
    one = replace(lens([1.0, -1.2], [0.2], [1.5, 1.0], 0.15), aspheric=((0.5, -3.0), (1.0, 2.0, -40.0)))
    disk, across, down = exit_disk(one, 1.5, 0.05), *spread(100)
    point, direction, weight, length = trace(path(one, disk), 0.03, 0.01, across, down, 1.5)
    assert np.mean(weight > 0) > 0.5
    for factor in (1e-3, 40.0):
        wide = Disk(disk.height * factor, disk.radius * factor)
        places = 0.03 * factor, 0.01 * factor, across, down, 1.5 * factor
        scaled = trace(path(one.scaled(factor), wide), *places)
        expected = (tuple(value * factor for value in point), direction, weight, length * factor)
        same(scaled, expected, 1e-12 * max(factor, 1))
        unscaled = trace(path(replace(one.scaled(factor), aspheric=one.aspheric), wide), *places)[1]
        assert np.abs(np.array(unscaled) - direction).max() > 1e-3, "the polynomial has an effect"


def test_rays_that_miss_an_asphere_are_blocked_and_leave_numbers() -> None:
    one = replace(lens([0.2, -1.0], [0.3], [1.5, 1.0], 0.19, conic=[0.5, 0.0]), aspheric=((200.0,), (-3.0,)))
    across, down = (number * 8 for number in spread(400))
    with np.errstate(all="raise"):
        (x, y), direction, weight, length = trace(path(one, Disk(0.1, 0.2)), 0.2, 0.0, across, down, 0.4)
    assert 0 < np.mean(weight > 0) < 0.2
    assert np.all(np.isfinite([x, y, *direction, length]))
    assert np.all(length[weight == 0] == 0)


def test_aspheric_terms_of_a_scene() -> None:
    front = BICONVEX[0] | {"aspheric": [0.5, -3]}
    camera = camera_with([front, BICONVEX[1]])
    one = prescription_of(camera, camera.types[0])
    spheres = camera_with(BICONVEX)
    plain = prescription_of(spheres, spheres.types[0])
    factor = one.radius[0]
    assert plain.aspheric == ()
    assert one.aspheric[0] == pytest.approx((0.5 / factor**3, -3 / factor**5))
    with pytest.raises(InputError, match=r"surfaces.*a6 = 1e\+07 mm\^-5"):
        camera_with([BICONVEX[0] | {"aspheric": [0.0, 1e7]}, BICONVEX[1]])
    with pytest.raises(InputError, match="at most 7"):
        camera_with([BICONVEX[0] | {"aspheric": [0.0] * 8}, BICONVEX[1]])


FIGURES: dict[str, Any] = json.loads(Path(__file__).with_name("oracle_rays.json").read_text(encoding="utf-8"))["lenses"]
EVERY = [(name, oracle) for name in ROWS for oracle in ("optiland", "rayoptics")]


def lens_of(name: str, tmp_path: Path, encoding: str = "utf-16") -> Prescription:
    (tmp_path / "lens.zmx").write_text(zmx(name), encoding=encoding)
    return prescribe(read_lens(tmp_path / "lens.zmx"), WAVELENGTH * 1e-3)


def image(one: Prescription, name: str, height: float) -> Array:
    """Return rows as the oracles', (5, rays)."""
    turned = turned_round(one)
    rear = turned.rear_principal - float(turned.vertices[-1])
    distance = turned.front_principal + ROWS[name][-1][1]
    across, down = np.array(pupil_points())
    (x, y), (u, v, w), weight, length = trace(
        path(turned, Disk(rear, PUPIL[name] / 2)), 0.0, height, across, down, OBJECT - rear
    )
    assert np.all(weight > 0)
    return np.stack([x + distance * u / w, y + distance * v / w, u, v, length + distance / w])


@pytest.mark.parametrize(("name", "oracle"), EVERY)
def test_rays_and_optical_paths(name: str, oracle: str, tmp_path: Path) -> None:
    """Focal length, places in the image, directions, optical paths, and the spots about their centres."""
    one = lens_of(name, tmp_path)
    figures = FIGURES[name][oracle]
    assert one.focal_length == pytest.approx(figures["focal_length"], rel=1e-9)
    for height in HEIGHTS:
        ours, theirs = image(one, name, height), np.array(figures["rays"][str(height)]).T
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)
        spots = [np.sqrt(np.sum(np.var(rows[:2], axis=1))) for rows in (ours, theirs)]
        assert spots[0] == pytest.approx(spots[1], rel=1e-9)
