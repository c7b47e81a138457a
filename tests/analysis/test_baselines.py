"""Baselines against cases whose images are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from ommatid.analysis import baselines
from ommatid.reconstruct.output import facts
from ommatid.reconstruct.output.run_json import MethodReport, RunReport
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from ..examples import THREE, Lenses, scene
from ..runs import report_of

RECORD: dict[str, Any] = {"seconds": 0.0, "versions": {}, "seed": 0, "first_seed": 0}


def recorded(
    image: FloatArray, lenses: Lenses, noise: float = 1e-4, seed: int | None = None, **lens: Any
) -> tuple[Stack, Model]:
    """The stack of an image in front of ideal lenses, without noise or with that of a seed, and its H."""
    tables = scene(image.shape, lenses, noise={"variance": noise}).plain()
    for table in tables["camera"]["lens"]:
        table.update(lens)
    described = parse(tables, Path("test.toml"))
    model = ideal_model(described, derive(described))
    values = model.forward(image)
    if seed is not None:
        values = values + np.random.default_rng(seed).normal(0, noise**0.5, values.size)
    return Stack(described, model.camera, values, np.zeros_like(values), RECORD), model


def picture(rows: int, columns: int) -> FloatArray:
    """A random image without symmetries."""
    return np.random.default_rng(1).uniform(0, 255, (rows, columns))


@pytest.mark.parametrize("side", [3, 5])
def test_pixels_whose_shifts_tile_the_grid_are_rearranged_to_the_box_average(side: int) -> None:
    """m x m pinholes a pixel of f apart: every pixel of f is the middle of one sensor pixel, but for the border."""
    image = picture(5 * side - 1, 4 * side - 1)
    stack, _ = recorded(image, ((f"1/{side}", [side, side], [4, 3]),))
    border = side // 2
    inner = np.s_[border:-border, border:-border]
    expected = ndimage.uniform_filter(image, side)  # mean of side x side pixels around each
    np.testing.assert_allclose(baselines.rearranged(stack)[inner], expected[inner], rtol=1e-12)


def test_a_pixel_halfway_between_two_is_written_to_both() -> None:
    """Pixels of 2 x 2: their middles are corners of f's pixels, which so get the mean of up to four of them."""
    image = picture(7, 7)
    stack, _ = recorded(image, (("1/2", [2, 2], [3, 3]),))
    corners = ndimage.uniform_filter(image, 2, origin=-1)  # mean of pixels i, i + 1
    np.testing.assert_allclose(
        baselines.rearranged(stack)[1:-1, 1:-1], ndimage.uniform_filter(corners, 2)[1:-1, 1:-1], rtol=1e-12
    )


@pytest.mark.parametrize("lens", [{}, {"distortion": [0.05, 0.02]}])
def test_uniform_images_stay_uniform(lens: dict[str, Any]) -> None:
    stack, _ = recorded(np.full((19, 19), 40.0), THREE, **lens)
    for image in (baselines.shift_and_add(stack), baselines.rearranged(stack)):
        np.testing.assert_allclose(image, 40, rtol=1e-9)


def test_shift_and_add_keeps_the_places_of_a_slope() -> None:
    """Cubic convolution is exact for straight lines, and so are boxes: only edges, beyond which values stay, differ."""
    slope = np.add.outer(3.0 * np.arange(31), 2.0 * np.arange(31))
    stack, _ = recorded(slope, (("1/3", [3, 3], "fit"), ("1/4", [4, 4], "fit")))
    inner = np.s_[12:-12, 12:-12]
    np.testing.assert_allclose(baselines.shift_and_add(stack)[inner], slope[inner], rtol=1e-9)


def test_total_variation_of_full_rank_readings_without_noise_is_the_truth() -> None:
    image = picture(19, 19)
    stack, model = recorded(image, THREE)
    found, _, _ = baselines.tuned_total_variation(stack, model, image)
    assert np.sqrt(np.mean((found - image) ** 2)) < 0.02, "less than the noise of 0.01 becomes in the estimate, 0.17"


def test_total_variation_denoises_a_step_to_two_levels() -> None:
    """H = 1. On a step of n columns each side, the minimiser moves each level by w variance / n (Strong, Chan 2003)."""
    image = np.where(np.arange(16) < 8, 50.0, 150.0) * np.ones((16, 1))
    stack, model = recorded(image, (("1", [1, 1], [16, 16]),), noise=4.0)
    found = baselines.TotalVariation(stack, model)(2.0, np.full(256, 100.0)).reshape(16, 16)
    np.testing.assert_allclose(found, image + np.where(image < 100, 1.0, -1.0) * 2.0 * 4.0 / 8, atol=0.02)


def test_dead_pixels_and_a_missing_library_leave_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    image = picture(19, 19)
    stack, model = recorded(image, THREE)
    values = stack.values.copy()
    values[::50] = np.nan
    with_gaps = replace(stack, values=values)
    monkeypatch.setattr(baselines, "find_spec", lambda _: None)
    assert "pip install pylops" in baselines.missing_methods(361)
    found = baselines.baselines(with_gaps, model, image)
    assert list(found.images) == ["single", "rearranged", "shift_and_add"]
    assert all(np.isfinite(each).all() for each in found.images.values())


def compared(mse: float, *errors: tuple[str, float]) -> RunReport:
    methods = [MethodReport(method=name, mse=each, psnr=None, ssim=None, seconds=1) for name, each in errors]  # pyright: ignore
    report = report_of(error={"mse": mse, "predicted_mse": mse, "budget": {"noise": mse}})
    return report.with_changes(baselines=tuple(methods))


def test_the_table_lists_the_least_error_first() -> None:
    for single, names in ((8.0, ["this estimate", "pixel rearrangement", "best single sub-image"]), (2.0, None)):
        rows = facts.baseline_rows(compared(4.0, ("single", single), ("rearranged", 6.0)))
        assert [row[0].partition(",")[0] for row in rows] == (
            names or ["best single sub-image", "this estimate", "pixel rearrangement"]
        )
