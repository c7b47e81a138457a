"""H of lenses with surfaces in closed form: against traced rays and waves, against a direct sum, and its limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.scenes.optics.field import TOLERANCE, optics_of
from ommatid.scenes.optics.point_spread import density, grid_of, point_spread
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.responses import measured
from ommatid.simulate.ideal import ideal_matrix

from ..examples import familywise, needs
from .test_lenses import built
from .test_lenses_against_ideal import scores, traced_in_a_world

SAMPLES = 2**14
ONE = (("1/3", [1, 2], [3, 3]),)
# Far from the best shape, wide open and off the axis: coma, astigmatism and a few waves of spherical aberration.
BENT = [
    {"radius": "-1.5 mm", "thickness": "0.3 mm", "index": 1.5, "semi_diameter": "0.1 mm", "stop": True},
    {"radius": "-0.5 mm", "semi_diameter": "0.165 mm"},
]
FLAT = [
    {"thickness": "0.3 mm", "index": 1.5, "semi_diameter": "0.12 mm", "stop": True},
    {"radius": "-1.0333 mm", "semi_diameter": "0.2 mm"},
]


def setup_of(surfaces: Any, wavelength: str, **more: Any) -> Setup:
    render = {"sampler": "independent", "complete": True}
    described = built({"surfaces": surfaces, **more}, ONE, (15, 15), calibration={"samples": SAMPLES}, render=render)
    camera = described.camera.model_copy(update={"wavelength": wavelength if wavelength == "none" else 5.5e-4})
    return Setup.from_scene(described.model_copy(update={"camera": camera}))


CASES = {
    "waves in focus": (FLAT, "550 nm", {}),
    "waves out of focus": (FLAT, "550 nm", {"focus": "300 mm"}),
    "waves with coma": (BENT, "550 nm", {}),
    "rays": (FLAT, "none", {"focus": "300 mm"}),
    "rays with coma": (BENT, "none", {}),
}


@pytest.mark.parametrize("kind", CASES)
def test_traced_h_is_the_closed_form(kind: str) -> None:
    needs("llvm_ad_mono")
    surfaces, wavelength, more = CASES[kind]
    setup = setup_of(surfaces, wavelength, **more)
    traced = measured(setup, by_points=False)
    lens = optics_of(setup.camera, setup.camera.types[0], None)
    # Rays alone leave through the whole exit disk; those that the lens blocks do not count.
    lit = float(lens.lit_share(np.zeros(1))[0]) if wavelength == "none" else 1.0
    found = scores(traced.matrix, ideal_matrix(setup.camera), traced.work.total * lit)
    assert found.size > 300
    assert np.abs(found).max() < stats.norm.isf(familywise(found.size) / 2)
    assert float(np.square(found).mean()) == pytest.approx(1, abs=5 * (2 / found.size) ** 0.5)


def test_an_entry_is_the_integral_of_the_point_spread_over_pixel_and_texel() -> None:
    """By brute force: densities at points of the target around one pixel's mean, times the overlaps."""
    camera = setup_of(BENT, "550 nm").camera
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


@pytest.mark.parametrize("kind", ["waves out of focus", pytest.param("waves with coma", marks=pytest.mark.slow)])
def test_rays_that_follow_the_distance_of_what_they_meet(kind: str) -> None:
    """In a world as before a flat target: H of a flat target that lenses have to find."""
    needs("llvm_ad_mono")
    surfaces, wavelength, more = CASES[kind]
    camera = setup_of(surfaces, wavelength, **more).camera
    found = scores(traced_in_a_world(camera, 4 * SAMPLES), ideal_matrix(camera), 4 * SAMPLES)
    assert np.abs(found).max() < stats.norm.isf(familywise(found.size) / 2)


def test_rows_add_up_to_the_light_that_the_target_sends() -> None:
    """All of it, but for what diffraction takes beyond the target and beyond the grid."""
    rays = ideal_matrix(setup_of(FLAT, "none").camera).sum(axis=1)
    waves = ideal_matrix(setup_of(FLAT, "550 nm").camera).sum(axis=1)
    assert rays.max() == pytest.approx(1, abs=1e-9)
    assert (waves < 0.996).all()
    assert (waves > 0.5).all()


def test_waves_on_a_grid_wider_than_their_own() -> None:
    """As for the middle of a field whose corner is blurred: the same light within its own, and never more than all."""
    setup = setup_of(FLAT, "550 nm")
    lens = optics_of(setup.camera, setup.camera.types[0], setup.camera.wavelength)
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
