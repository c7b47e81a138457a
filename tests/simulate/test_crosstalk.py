"""A camera without walls: H and light through every lens against rays of the thin-lens equation, drawn here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.negligible import skipped_effects
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.pose import corner_offset
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import rendered_model
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.renderer import Renderer

from ..examples import GALLERY, familywise, mean_weights, needs, scene, with_optics

FAST = "llvm_ad_mono"
SMALL = (("1/3", [2, 2], [2, 2]), ("1/5", [2, 2], [1, 1]))
OPEN = {"walls": False, "wavelength": "none", "lens_pitch": "0.02 mm"}  # neighbours look at the target, too
TRANSPORT = {"method": "transport", "samples": 16384}
BATCHES = 16


def open_camera(aperture: str = "0.02 mm", **tables: Any) -> tuple[Scene, Camera]:
    return with_optics({"aperture": aperture}, OPEN, SMALL, (31, 31), **{"calibration": TRANSPORT, **tables})


def drawn(camera: Camera, rays: int, rng: np.random.Generator) -> np.ndarray:
    """Return H, (M, N), by `rays` random rays of each pixel through each lens.

    A ray from p on the sensor crosses a lens at l + a and meets the target, at Z, in
    l + a + Z ((l + a - p) / d - a / focal length); it carries aperture^2 cos^4.
    """
    rows = np.zeros((camera.measurements, camera.unknowns))
    for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
        left, top = corner_offset(camera, sub)
        for number in range(pixels.stop - pixels.start):
            row, column = divmod(number, sub.type.pixels[1])
            corner = np.array([left, top]) + np.array([column, row]) * camera.pixel_pitch + sub.patch
            total = 0.0
            for other in camera.sub_imagers:
                aperture = other.type.optics.aperture or 0.0
                radius, angle = aperture / 2 * np.sqrt(rng.random(rays)), rng.random(rays) * 2 * np.pi
                a = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
                p = corner[:, None] + rng.random((2, rays)) * camera.pixel_pitch
                at = np.array(other.lens)[:, None] + a
                slope = (at - p) / sub.depth
                weight = aperture**2 / (1 + np.square(slope).sum(axis=0)) ** 2
                total += weight.sum()
                x, y = at + camera.distance * (slope - a / camera.focal_length(other.type))
                texel = np.floor(camera.rows / 2 - y / camera.target_pitch).astype(int)
                across = np.floor(camera.columns / 2 - x / camera.target_pitch).astype(int)
                hit = (texel >= 0) & (texel < camera.rows) & (across >= 0) & (across < camera.columns)
                where = texel[hit] * camera.columns + across[hit]
                rows[pixels.start + number] += np.bincount(where, weight[hit], camera.unknowns)
            rows[pixels.start + number] /= total
    return rows


def test_h_is_that_of_rays_through_every_lens() -> None:
    """Own lenses in focus, those of the other type far out of it; entry by entry, in standard errors of both."""
    needs(FAST)
    described, camera = open_camera()
    model = rendered_model(Setup(described, camera))
    rng = np.random.default_rng(5)
    batches = np.stack([drawn(camera, 1024, rng) for _ in range(BATCHES)])
    expected, variance = batches.mean(axis=0), batches.var(axis=0, ddof=1) / BATCHES
    found, known = model.matrix.toarray(), np.zeros(expected.shape)
    rows = np.repeat(np.arange(camera.measurements), np.diff(model.matrix.indptr))
    known[rows, model.matrix.indices] = model.variance
    common = (expected > 2e-4) & (found > 0)  # of about 16384 / 2 / 7 rays per lens
    assert common.sum() > 2000
    score = np.abs(found - expected)[common] / np.sqrt(variance + known)[common]
    assert score.max() < stats.t.isf(familywise(int(common.sum())) / 2, BATCHES - 1)
    with_walls = ideal_matrix(with_optics({"aperture": "0.02 mm"}, OPEN | {"walls": True}, SMALL, (31, 31))[1])
    crossed = found * (with_walls.toarray() == 0)
    assert 0.3 < float(crossed.sum() / found.sum()) < 0.95, "most light comes through the other lenses"
    assert float(crossed.sum()) == pytest.approx(float((expected * (with_walls.toarray() == 0)).sum()), rel=2e-3)


@pytest.mark.parametrize("pitch", ["0.02 mm", "0.5 mm"])
def test_electrons_and_weights_of_rays_count_every_lens(pitch: str) -> None:
    """The mean weight of a pixel's rays is its light over that of a lens on the axis."""
    needs(FAST)
    sensor: dict[str, Any] = {"sensor": {"illuminance": "500 lux", "exposure": "10 ms"}, "calibration": TRANSPORT}
    table = OPEN | {"lens_pitch": pitch}
    described, camera = with_optics({"aperture": "0.01 mm"}, table, SMALL, (31, 31), **sensor)
    response = electrons(described, camera)
    renderer = Renderer(camera, FAST, together=False)
    for group in renderer.groups:
        rows = renderer.rows(group)
        weights = mean_weights(renderer, group, 16384)
        ratio = response[rows] / weights
        np.testing.assert_allclose(ratio, ratio[0], rtol=2e-3)
    closed = with_optics({"aperture": "0.01 mm"}, table | {"walls": True}, SMALL, (31, 31), **sensor)
    gained = response / electrons(*closed)
    # Neighbours at 0.02 mm are next to the axis of lenses 1.2 and 2 mm before the sensor: all eight count nearly alike.
    if pitch == "0.02 mm":
        np.testing.assert_allclose(gained, 8, rtol=5e-3)
    else:
        assert np.ptp(gained) > 0.5, "far lenses do not"


def test_walls_are_said_and_what_is_unclear_without_them_refused() -> None:
    described, camera = with_optics({"aperture": "0.1 mm"}, {})
    assert "light through neighbouring lenses" in [effect.what for effect in skipped_effects(described, camera)]
    described, camera = open_camera()
    assert "light through neighbouring lenses" not in [effect.what for effect in skipped_effects(described, camera)]
    with pytest.raises(InputError, match=r"camera\.walls = false: light through several lenses has no closed form"):
        ideal_matrix(camera)
    with pytest.raises(InputError, match=r"expected calibration\.method 'transport', no fit, got 'points'"):
        open_camera(calibration={"method": "points"})
    with pytest.raises(InputError, match="add an aperture or keep the walls"):
        scene(camera={"walls": False})
    with pytest.raises(InputError, match="walls = false needs thin lenses"):
        read(GALLERY / "doublet.toml", ["camera.walls=false"])
