"""Calibration by ray transport: the same H as from point sources."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.point_sources import responses_from_points
from ommatid.simulate.calibration.ray_transport import responses_from_rays
from ommatid.simulate.render import light

from ..examples import OPTICS, assert_student, needs, with_optics

SMALL = (("1/3", [2, 1], [2, 2]), ("1/4", [1, 2], [1, 1]))


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow) if kind in ("diffraction", "out of focus") else kind
        for kind in OPTICS
    ],
)
def test_h_is_that_of_point_sources(kind: str) -> None:
    """From the same rays, in float64: entries, variances and batches."""
    needs("llvm_ad_mono")
    tables = {"calibration": {"samples": 32}, "render": {"complete": True, "variant": "llvm_ad_mono"}}
    setup = Setup(*with_optics(*OPTICS[kind], SMALL, (7, 7), **tables))
    by_rays, by_points = responses_from_rays(setup), responses_from_points(setup)
    assert abs(by_rays.matrix - by_points.matrix).max() < 1e-6 * by_points.matrix.max()
    np.testing.assert_allclose(by_rays.variance, by_points.variance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(by_rays.batches, by_points.batches, atol=1e-7)


@pytest.mark.parametrize("kind", OPTICS)
def test_h_predicts_the_rendering_of_a_photograph(kind: str) -> None:
    """H f with the calibrated H against rendered sub-images, which have other rays."""
    needs("llvm_ad_mono")
    samples = {"samples": 4096}
    setup = Setup(*with_optics(*OPTICS[kind], calibration={**samples, "method": "transport"}, render=samples))
    model, rendered = calibrate(setup), light(setup)
    variance = rendered.variance + model.variance_from_model(setup.image)
    assert_student(model.forward(setup.image) - rendered.mean, variance, rendered.passes)


def test_the_scalar_backend_is_refused_with_a_remedy() -> None:
    setup = Setup(*with_optics({}, {}, calibration={"method": "transport"}, render={"variant": "scalar_rgb"}))
    with pytest.raises(InputError, match="needs Mitsuba's fast backend, got scalar_rgb; run: "):
        calibrate(setup)
    for lens, more in list(OPTICS.values())[1:]:
        setup = Setup(*with_optics(lens, more, render={"variant": "scalar_rgb", "samples": 16}))
        with pytest.raises(InputError, match="more than pinholes need Mitsuba's fast backend"):
            light(setup)


def test_pixels_in_blocks_give_the_same_picture_with_other_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """If memory does not hold all rays at once: both methods still agree, and blocks have different seeds."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer import rays

    one = (("1/3", [1, 1], [4, 4]),)
    tables = {"calibration": {"samples": 64}, "render": {"samples": 4096, "variant": "llvm_ad_mono"}}
    image = np.arange(12.0)[:, None] * np.ones(12)
    setup = Setup(*with_optics({}, {}, one, (12, 12), **tables), image)
    whole = light(setup)
    monkeypatch.setattr(rays, "MOST_RAYS", 4 * 256)
    pieces = light(setup)
    assert_student(pieces.mean - whole.mean, pieces.variance + whole.variance, whole.passes)
    assert (pieces.mean[:4] == whole.mean[:4]).all(), "the first block has the same seed"
    assert (pieces.mean[4:] != whole.mean[4:]).any()
    assert (light(setup).mean == pieces.mean).all(), "repeatable"
    monkeypatch.setattr(rays, "MOST_RAYS", 4 * 4)
    by_rays, by_points = responses_from_rays(setup), responses_from_points(setup)
    assert abs(by_rays.matrix - by_points.matrix).max() < 1e-12
    np.testing.assert_allclose(by_rays.variance, by_points.variance, rtol=1e-9, atol=1e-15)
