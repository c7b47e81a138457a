"""Three Zemax files, read and traced here and by two other ray tracers (`oracle_rays`): the same to 1e-10.

Light runs from the object to the image there; so the lens is turned round here, and its sensor is the object.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ommatid.scenes.formats.lens_file import read_lens
from ommatid.simulate.lenses.prescription import Prescription, prescribe
from ommatid.simulate.lenses.ray_trace import Disk, trace_path

from ..lenses import turned_round
from .oracle_rays import HEIGHTS, WAVELENGTH, pupil_points
from .zemax_lenses import OBJECT, PUPIL, ROWS, zmx

Array = NDArray[np.float64]
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
    (x, y), (u, v, w), weight, length = trace_path(
        turned, Disk(rear, PUPIL[name] / 2), 0.0, height, across, down, OBJECT - rear
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


@pytest.mark.parametrize(("name", "oracle"), EVERY)
def test_distortion(name: str, oracle: str, tmp_path: Path) -> None:
    """The chief ray's height over that of a low one, times the ratio of their objects: to 1e-6 of it."""
    one = lens_of(name, tmp_path)
    figures = FIGURES[name][oracle]["rays"]
    ours = [image(one, name, height)[1, 0] for height in HEIGHTS[1:]]
    theirs = [figures[str(height)][0][1] for height in HEIGHTS[1:]]
    distortion = [2 * np.divide(*pair) - 1 for pair in (ours, theirs)]
    assert distortion[0] == pytest.approx(distortion[1], rel=1e-6)
    assert abs(distortion[1]) > 1e-5


def test_the_figures_see_half_of_every_aspheric_term(tmp_path: Path) -> None:
    one = lens_of("asphere", tmp_path, "latin-1")
    theirs = np.array(FIGURES["asphere"]["rayoptics"]["rays"]["6.0"]).T
    halves = [replace(one, conic=one.conic * 0.5)]
    for surface, term in np.ndindex(2, 3):
        rows = [list(row) for row in one.aspheric]
        rows[surface][term] *= 0.5
        halves.append(replace(one, aspheric=tuple(tuple(row) for row in rows)))
    for half in halves:
        np.testing.assert_array_less(1e-7, np.abs(image(half, "asphere", 6.0) - theirs).max())
