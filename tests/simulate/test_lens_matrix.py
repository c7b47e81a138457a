"""H of lenses with surfaces in closed form: against a direct sum, and its limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.field import TOLERANCE, optics_of
from ommatid.scenes.optics.point_spread import density, grid_of, point_spread
from ommatid.simulate.ideal import ideal_matrix

from ..examples import with_optics

# Far from the best shape, wide open and off the axis: coma, astigmatism and a few waves of spherical aberration.
BENT = [
    {"radius": "-1.5 mm", "thickness": "0.3 mm", "index": 1.5, "semi_diameter": "0.1 mm", "stop": True},
    {"radius": "-0.5 mm", "semi_diameter": "0.165 mm"},
]
FLAT = [
    {"thickness": "0.3 mm", "index": 1.5, "semi_diameter": "0.12 mm", "stop": True},
    {"radius": "-1.0333 mm", "semi_diameter": "0.2 mm"},
]


ONE = (("1/3", [1, 2], [3, 3]),)


def camera_of(surfaces: Any, wavelength: str) -> Camera:
    return with_optics({"surfaces": surfaces}, {"wavelength": wavelength}, ONE, (15, 15))[1]


def test_an_entry_is_the_integral_of_the_point_spread_over_pixel_and_texel() -> None:
    """By brute force: densities at points of the target around one pixel's mean, times the overlaps."""
    camera = camera_of(BENT, "550 nm")
    lens = optics_of(camera, camera.types[0], camera.wavelength)
    row = ideal_matrix(camera)[[0]].toarray().reshape(camera.shape)
    (sub, *_) = camera.sub_imagers
    x, y = (sub.patch[axis] - sub.lens[axis] - camera.pixel_pitch for axis in (0, 1))
    height, pitch = float(np.hypot(x, y)), camera.target_pitch
    wave = lens.lit_wave(height).turned(float(np.arctan2(-x, y)))
    step = pitch / 16
    offsets = (np.arange(-40 * 16, 40 * 16) + 0.5) * step
    across, up = (np.asarray(axis, dtype=np.float64) for axis in np.meshgrid(offsets, offsets))
    light = density(wave, across.ravel(), up.ravel()).reshape(across.shape) * step**2
    half = np.array([-camera.pixel_pitch, camera.pixel_pitch]) / 2
    edges_x, edges_y = lens.chief_ray(x + half, np.array([y, y]))[0], lens.chief_ray(np.array([x, x]), y + half)[1]
    columns = camera.columns / 2 - (sub.lens[0] + edges_x[:, None] + offsets) / pitch
    rows = camera.rows / 2 - (sub.lens[1] + edges_y[:, None] + offsets) / pitch

    def overlap(edges: np.ndarray, texel: int) -> np.ndarray:
        low, high = np.maximum(edges.min(axis=0), texel), np.minimum(edges.max(axis=0), texel + 1)
        return np.maximum(high - low, 0) / np.ptp(edges, axis=0)

    assert row.max() > 50 * TOLERANCE / 9
    for texel in ((0, 0), (1, 2), (4, 4), (9, 3), divmod(int(row.argmax()), camera.columns)):
        expected = overlap(rows, texel[0]) @ light @ overlap(columns, texel[1])
        # A texel is a ninth of the footprint: so much of the point-spread function's error at most is in an entry.
        assert row[texel] == pytest.approx(expected, abs=TOLERANCE / 9)


def test_waves_on_a_grid_wider_than_their_own() -> None:
    """As for the middle of a field whose corner is blurred: the same light within its own, and never more than all."""
    camera = camera_of(FLAT, "550 nm")
    lens = optics_of(camera, camera.types[0], camera.wavelength)
    near = lens.wave(0.0, lens.wavelength)
    assert near is not None
    cell, half = grid_of(near)
    far = lens.wave(0.0, lens.wavelength, 2 * half)
    assert far is not None
    expected, found = point_spread(near), point_spread(far, (cell, 2 * half))
    edge = (len(found.values) - len(expected.values)) // 2
    middle = found.values[edge:-edge, edge:-edge]
    np.testing.assert_allclose(middle, expected.values, atol=1e-6 * expected.values.max())
    assert expected.inside < found.inside < 1
