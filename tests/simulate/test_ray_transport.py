"""Calibration by ray transport: the same H as from point sources."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.responses import measured, one_pass
from ommatid.simulate.render import light
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.sampling.passes import Plan

from ..examples import OPTICS, assert_student, needs, with_optics

SMALL = (("1/3", [2, 1], [2, 2]), ("1/4", [1, 2], [1, 1]))


def test_h_is_that_of_point_sources() -> None:
    """From the same rays, in float64: entries, variances and batches."""
    needs("llvm_ad_mono")
    tables = {"calibration": {"samples": 32}, "render": {"complete": True, "variant": "llvm_ad_mono"}}
    setup = Setup(*with_optics({}, {}, SMALL, (7, 7), **tables))
    by_rays, by_points = measured(setup, by_points=False), measured(setup, by_points=True)
    assert abs(by_rays.matrix - by_points.matrix).max() < 1e-6 * by_points.matrix.max()
    np.testing.assert_allclose(by_rays.variance, by_points.variance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(by_rays.batches, by_points.batches, atol=1e-7)


@pytest.mark.parametrize("kind", [*OPTICS, "blurred"])
def test_a_column_of_h_is_the_picture_of_its_point_source(kind: str) -> None:
    """Behind every lens: pixels of f shine one by one, and are rendered as any picture, by the rays of one pass."""
    needs("llvm_ad_mono")
    optics = {**OPTICS, "blurred": ({}, {"pixel_blur": "2 um"})}[kind]
    setup = Setup(*with_optics(*optics, SMALL, (7, 7), calibration={"samples": 32}, render={"complete": True}))
    renderer, work = Renderer(setup.simulated, "llvm_ad_mono", "multijitter", together=False), Plan(2, 16)
    for group in renderer.groups:
        pixels = renderer.pixels(group)
        entries = one_pass(renderer, pixels, work, 0, 0).matrix.toarray()
        seeds = [sampler_seeds(0, "calibration", 0, work.passes)]
        for texel, column in enumerate(entries.T):
            renderer.set_target((np.arange(49) == texel).astype(float).reshape(7, 7))
            seen = renderer.expose(pixels, work.samples, seeds)[0, 0]
            np.testing.assert_allclose(np.nan_to_num(seen), column, atol=1e-6)
        assert entries.sum() > 0.8 * len(entries)
        renderer.set_target(np.ones((7, 7)))


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
    with pytest.raises(InputError, match=r"needs Mitsuba.s fast backend, got scalar_rgb; leave out render\.variant"):
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
    by_rays, by_points = measured(setup, by_points=False), measured(setup, by_points=True)
    assert abs(by_rays.matrix - by_points.matrix).max() < 1e-12
    np.testing.assert_allclose(by_rays.variance, by_points.variance, rtol=1e-9, atol=1e-15)
