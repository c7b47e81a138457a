"""Three Zemax files, read and traced here and by two other ray tracers (`oracle_rays`): the same to 1e-10.

Light runs from the object to the image there; so the lens is turned round here, and its sensor is the object.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.optics.prescription import Prescription, prescribe
from ommatid.scenes.optics.ray_trace import Disk, path, trace

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
