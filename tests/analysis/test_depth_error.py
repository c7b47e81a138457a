"""Error due to depth: disparity against rays through lenses, and error by distance."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ommatid.analysis.depth_error import PICTURE, depth_error_of_run, disparity, draw, error_by_depth, rows
from ommatid.scenes.formats.exr import Part, write
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.formats.picture_file import read_picture
from ommatid.scenes.scene import TRUTH

from ..examples import camera as camera_of

CAMERA = camera_of()
RNG = np.random.default_rng(7)
SHAPE = (19, 19)


@given(st.floats(50, 1e6), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_disparity_agrees_with_rays_through_the_lenses(z: float, slope_x: float, slope_y: float) -> None:
    """A point on the ray of a pixel of the truth, seen by every lens: where its ray meets the target's plane."""
    point = np.array([slope_x * z, slope_y * z, z])
    true = point * (CAMERA.distance / z)
    squares: dict[str, list[float]] = {}
    for sub in CAMERA.sub_imagers:
        lens = np.array([*sub.lens, 0.0])
        met = lens + (point - lens) * (CAMERA.distance / (point - lens)[2])
        squares.setdefault(sub.type.name, []).append(float(np.sum((met - true) ** 2)) / CAMERA.target_pitch**2)
    for name, value in disparity(CAMERA, z).items():
        assert float(value) == pytest.approx(float(np.mean(squares[name])) ** 0.5, abs=1e-8, rel=1e-9)


def test_disparity_vanishes_on_the_targets_plane_and_ends_at_the_offset() -> None:
    depth = np.array([CAMERA.distance, np.inf, np.nan])
    for lens_type in CAMERA.types:
        lenses = np.array([sub.lens for sub in CAMERA.sub_imagers if sub.type == lens_type])
        offset = np.sqrt((lenses**2).sum(axis=1).mean()) / CAMERA.target_pitch
        np.testing.assert_allclose(disparity(CAMERA, depth)[lens_type.name], [0, offset, offset])


def maps() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    depth = RNG.uniform(500, 4000, SHAPE)
    depth[:2] = np.nan
    return depth, RNG.normal(0, 3, SHAPE), RNG.uniform(1, 4, SHAPE)


def test_bins_hold_every_pixel_once_and_their_squares_add_up() -> None:
    depth, error, variance = maps()
    bins = error_by_depth(CAMERA, depth, error, variance)
    counts = np.array([depth_bin.pixels for depth_bin in bins])
    assert counts.sum() == depth.size
    assert counts[-1] == 38
    assert bins[-1].nearest is None
    assert counts @ [depth_bin.rms_error**2 for depth_bin in bins] == pytest.approx((error**2).sum())
    assert counts @ [depth_bin.expected_deviation**2 for depth_bin in bins] == pytest.approx(variance.sum())
    ends = [(depth_bin.nearest or 0.0, depth_bin.farthest or 0.0) for depth_bin in bins[:-1]]
    assert ends[0][0] == np.nanmin(depth)
    assert ends[-1][1] == np.nanmax(depth)
    assert all(before[1] <= after[0] for before, after in pairwise(ends))
    widths = np.array([1 / near - 1 / far for near, far in ends])
    assert widths.max() <= (1 / np.nanmin(depth) - 1 / np.nanmax(depth)) / 10 * (1 + 1e-9)
    json.dumps([depth_bin.plain() for depth_bin in bins], allow_nan=False)


def test_disparity_of_a_bin_is_that_of_its_sub_imagers() -> None:
    depth, error, variance = maps()
    depth[:] = 500.0
    (depth_bin,) = error_by_depth(CAMERA, depth, error, variance)
    lenses = np.array([sub.lens for sub in CAMERA.sub_imagers])
    assert depth_bin.rms_disparity == pytest.approx(float(np.sqrt((lenses**2).sum(axis=1).mean())))  # Z/z - 1 = 1, 1 mm
    assert depth_bin.nearest == depth_bin.farthest == 500
    assert depth_bin.pixels == 361


def test_a_world_without_surfaces_has_one_bin() -> None:
    _, error, variance = maps()
    (depth_bin,) = error_by_depth(CAMERA, np.full(SHAPE, np.nan), error, variance)
    assert (depth_bin.nearest, depth_bin.farthest, depth_bin.pixels) == (None, None, 361)
    assert rows([depth_bin])[0][0] == "no surface"


@pytest.mark.parametrize("distance", [None, np.nan, 3200.3])
def test_a_figure_is_drawn(tmp_path: Path, distance: float | None) -> None:
    depth, error, variance = maps()
    depth[:] = depth if distance is None else distance
    draw(tmp_path / PICTURE, CAMERA, error_by_depth(CAMERA, depth, error, variance), "$a$ title")
    drawn: NDArray[Any] = read_picture(tmp_path / PICTURE, "test").pixels
    assert drawn.shape[0] > 400
    assert drawn.std() > 5


def test_the_error_of_a_run_comes_from_its_files(tmp_path: Path) -> None:
    depth, error, variance = maps()
    truth = RNG.uniform(0, 255, SHAPE)
    maps_of = {"estimate": truth + error, "truth": truth, "variance": variance}
    write(tmp_path / "estimate.exr", [Part("estimate", {k: v.astype(np.float32) for k, v in maps_of.items()}, {})])
    write_truth(tmp_path / TRUTH, truth)
    assert depth_error_of_run(tmp_path, CAMERA) == ()
    write_truth(tmp_path / TRUTH, truth, depth)
    bins, expected = depth_error_of_run(tmp_path, CAMERA), error_by_depth(CAMERA, depth, error, variance)
    assert [depth_bin.pixels for depth_bin in bins] == [depth_bin.pixels for depth_bin in expected]
    assert [depth_bin.rms_error for depth_bin in bins] == pytest.approx(
        [depth_bin.rms_error for depth_bin in expected], rel=1e-5
    )
    assert (tmp_path / PICTURE).is_file()
