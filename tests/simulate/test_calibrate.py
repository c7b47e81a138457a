"""Calibration: rows, grids, rays against point sources, and stated uncertainties against real errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.progress import no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes import model_file
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import agreement, cached_model, calibrate
from ommatid.simulate.calibration import point_sources
from ommatid.simulate.calibration.point_sources import VisiblePixels, of_pinholes
from ommatid.simulate.calibration.responses import measured, one_pass
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import light
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.sampling.passes import Plan

from ..examples import OPTICS, assert_student, needs, scene, with_optics


def small(seed: int = 0, samples: int = 64) -> Scene:
    render = {"variant": "scalar_rgb", "seed": seed}
    return scene((12, 12), (("1/3", [2, 2], [3, 3]),), render=render, calibration={"samples": samples})


def test_no_two_sources_of_a_grid_reach_one_sensor_pixel() -> None:
    described = scene((23, 23), (("1/3", [3, 3], "fit"), ("2/7", [2, 2], "fit"), ("1/5", [2, 2], "fit")))
    camera = derive(described)
    ideal = ideal_matrix(camera)
    start = 0
    for lens_type in camera.types:
        rows = ideal[start : start + lens_type.measurements]
        start += lens_type.measurements
        spacing = of_pinholes(camera, lens_type).spacing
        lit = np.zeros((23, 23))
        for offset in range(spacing**2):
            sources = point_sources.sources(camera, spacing, range(offset, offset + 1), np.array([1]))
            lit += sources
            seen = (rows != 0).astype(np.float64) @ sources.ravel()
            assert seen.max() <= 1
        assert (lit == 1).all(), "every pixel of f is lit once"


@pytest.mark.parametrize(("shape", "ratio"), [((1, 1), 1), ((1, 5), 1), ((2, 2), "1/2")])
def test_cameras_of_a_pixel_are_fitted(shape: tuple[int, int], ratio: int | str, tmp_path: Path) -> None:
    """Whose sub-images say nothing of where they look, and whose target is a single row: the H as designed."""
    described = scene(
        shape, ((ratio, [1, 1], [1, 1]),), render={"variant": "scalar_rgb"}, calibration={"samples": 64, "fit": "auto"}
    )
    found, _ = cached_model(tmp_path / "model.npz", Setup.from_scene(described), no_progress)
    np.testing.assert_allclose(found.observation.to_sparse().toarray(), ideal_matrix(found.camera).toarray())


def test_a_source_assigned_to_the_wrong_pixel_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    described = small()
    camera = derive(described)
    right = point_sources.visible_pixels

    def wrong(renderer: Any, pixels: Any) -> VisiblePixels:
        visible = right(renderer, pixels)
        return replace(visible, row=visible.row + 3, column=visible.column + 3)

    monkeypatch.setattr(point_sources, "visible_pixels", wrong)
    with pytest.raises(MachineError, match="uniform"):
        measured(Setup(described, camera), by_points=True)


def test_the_stated_uncertainty_of_h_is_its_real_error() -> None:
    """Over thirty seeds: for its entries, and for their effect on the measurements of a photograph."""
    ideal = ideal_matrix(derive(small()))
    image = load(small())
    entries: list[float] = []
    measured: list[float] = []
    for seed in range(30):
        described = small(seed)
        found = calibrate(Setup.from_scene(described))
        difference = sparse.csr_array(found.matrix - ideal)
        entries.append(float((difference.data**2).sum() / found.variance.sum()))
        error = found.forward(image) - ideal @ image.ravel()
        measured.append(float((error**2).sum() / found.variance_from_model(image).sum()))
    for ratios in (entries, measured):
        assert abs(np.mean(ratios) - 1) < 4 * np.std(ratios, ddof=1) / 30**0.5 + 0.05


def test_a_wrong_entry_disagrees_with_the_ideal_model() -> None:
    described = small(samples=1024)
    camera = derive(described)
    found = calibrate(Setup(described, camera))
    assert found.record["agreement"]["p_value"] > 0.01
    wrong = found.matrix.copy()
    wrong.data[40] += 0.05
    worse = agreement(sparse.csr_array(wrong), found.variance, camera, 16)
    assert worse["p_value"] < 1e-4
    missing = found.matrix.copy()
    missing.data[40] = 0.0
    missing.eliminate_zeros()
    kept = np.delete(found.variance, 40)
    assert agreement(sparse.csr_array(missing), kept, camera, 16)["p_value"] < 1e-4
    dark = agreement(sparse.csr_array(found.matrix.shape), np.empty(0), camera, 16)
    assert (dark["max_z"], dark["p_value"]) == (0.0, 1.0), "no ray has hit, so nothing is known"
    assert dark["rms_difference_from_ideal"] > 0


def test_ideal_calibration_has_no_uncertainty() -> None:
    described = scene(calibration={"method": "ideal"})
    found = calibrate(Setup.from_scene(described))
    assert not found.variance.any()
    assert not found.variance_from_model(load(described)).any()


def test_a_model_file_gives_the_same_model(tmp_path: Path) -> None:
    described = small()
    found = calibrate(Setup.from_scene(described))
    model_file.write(tmp_path / "model.npz", found)
    again = model_file.read(tmp_path / "model.npz")
    assert (again.matrix != found.matrix).nnz == 0
    np.testing.assert_array_equal(again.variance, found.variance)
    np.testing.assert_array_equal(again.batches, found.batches)
    assert again.record == found.record
    plain = sparse.load_npz(tmp_path / "model.npz")
    assert (plain != found.matrix).nnz == 0
    assert np.load(tmp_path / "model.npz")["variance"].shape == plain.data.shape


def test_restrict_keeps_rows_and_their_uncertainty() -> None:
    described = scene(
        (12, 12),
        (("1/3", [2, 2], [3, 3]), ("1/4", [2, 2], [2, 2])),
        render={"variant": "scalar_rgb"},
        calibration={"samples": 16},
    )
    found = calibrate(Setup.from_scene(described))
    second = found.restrict(("B",))
    assert second.measurements == 16
    image = load(described)
    np.testing.assert_array_equal(second.forward(image), found.forward(image)[36:])
    np.testing.assert_allclose(second.variance_from_model(image), found.variance_from_model(image)[36:])
    with pytest.raises(InputError, match="'Z'"):
        found.restrict(("Z",))


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
