"""Calibration by transport: the same H as point sources give, from the rays alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.point_sources import responses_from_points
from ommatid.simulate.calibration.ray_transport import responses_from_rays
from ommatid.simulate.render import light

from ..examples import THREE, Lenses, assert_student, needs, scene

TWO = THREE[:2]
SMALL = (("1/3", [2, 1], [2, 2]), ("1/4", [1, 2], [1, 1]))
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "pinhole": ({}, {}),
    "out of focus": ({"aperture": "0.4 mm", "focus": "900 mm"}, {}),
    "diffraction": ({"aperture": "0.8 mm"}, {"wavelength": "550 nm"}),
    "distortion": ({"distortion": [0.05, 0.02]}, {}),
    "misaligned": ({}, {"tolerance": {"position": "1 um", "rotation": "1 deg", "tilt": "1 deg"}}),
}


def built(
    lens: dict[str, Any],
    camera: dict[str, Any],
    lenses: Lenses = TWO,
    shape: tuple[int, int] = (19, 19),
    **tables: Any,
) -> tuple[Scene, Camera]:
    """A scene whose every lens type has these keys, and its camera."""
    data = scene(shape, lenses, **tables).plain()
    for described in data["camera"]["lens"]:
        described.update(lens)
    data["camera"].update(camera)
    described = parse(data, Path("test.toml"))
    return described, derive(described)


@pytest.mark.parametrize("kind", KINDS)
def test_it_gives_the_h_of_point_sources(kind: str) -> None:
    """The same rays in float64: entry by entry, its variance and its batches."""
    needs("llvm_ad_mono")
    tables = {"calibration": {"samples": 32}, "render": {"complete": True, "variant": "llvm_ad_mono"}}
    described, camera = built(*KINDS[kind], SMALL, (7, 7), **tables)
    by_rays, by_points = responses_from_rays(Setup(described, camera)), responses_from_points(Setup(described, camera))
    assert abs(by_rays.matrix - by_points.matrix).max() < 1e-6 * by_points.matrix.max()
    np.testing.assert_allclose(by_rays.variance, by_points.variance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(by_rays.batches, by_points.batches, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_its_h_renders_the_photograph(kind: str) -> None:
    """H f of a calibrated H against the rendered sub-images, which have other rays."""
    needs("llvm_ad_mono")
    samples = {"samples": 4096}
    described, camera = built(*KINDS[kind], calibration={**samples, "method": "transport"}, render=samples)
    model, rendered = calibrate(Setup(described, camera)), light(Setup(described, camera))
    spread = rendered.variance + model.variance_from_model(load(described))
    assert_student(model.forward(load(described)) - rendered.mean, spread, rendered.passes)


def test_without_the_fast_backend_one_sentence_says_what_to_do() -> None:
    described, camera = built({}, {}, calibration={"method": "transport"}, render={"variant": "scalar_rgb"})
    with pytest.raises(InputError, match="needs Mitsuba's fast backend, got scalar_rgb; run: "):
        calibrate(Setup(described, camera))
    for lens, more in list(KINDS.values())[1:]:
        described, camera = built(lens, more, render={"variant": "scalar_rgb", "samples": 16})
        with pytest.raises(InputError, match="more than pinholes need Mitsuba's fast backend"):
            light(Setup(described, camera))


def test_progress_ends_at_one() -> None:
    needs("llvm_ad_mono")
    described, camera = built({}, {}, calibration={"samples": 16})
    told: list[float] = []
    responses_from_rays(Setup(described, camera), told.append)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)


def test_pixels_in_blocks_give_the_same_picture_with_other_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where memory does not hold all rays at once: transport is still points, and blocks are not alike."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer import rays

    one = (("1/3", [1, 1], [4, 4]),)
    tables = {"calibration": {"samples": 64}, "render": {"samples": 4096, "variant": "llvm_ad_mono"}}
    described, camera = built({}, {}, one, (12, 12), **tables)
    flat = load(described)
    flat[:, :6] = flat[:, 6:] = np.arange(12.0)[:, None] * np.ones(6)
    whole = light(Setup(described, camera, flat))
    monkeypatch.setattr(rays, "MOST_RAYS", 4 * 256)
    pieces = light(Setup(described, camera, flat))
    assert_student(pieces.mean - whole.mean, pieces.variance + whole.variance, whole.passes)
    assert (pieces.mean[:4] == whole.mean[:4]).all(), "the first block has the seed itself"
    assert (pieces.mean[4:] != whole.mean[4:]).any()
    assert (light(Setup(described, camera, flat)).mean == pieces.mean).all(), "and all of them always the same"
    monkeypatch.setattr(rays, "MOST_RAYS", 4 * 4)
    by_rays, by_points = responses_from_rays(Setup(described, camera)), responses_from_points(Setup(described, camera))
    assert abs(by_rays.matrix - by_points.matrix).max() < 1e-12
    np.testing.assert_allclose(by_rays.variance, by_points.variance, rtol=1e-9, atol=1e-15)
