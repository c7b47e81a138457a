"""The best single sub-image: its place on f's grid, its interpolation, and its choice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ommatid.reconstruct.measured_error import best_single_sub_image, enlarged, positions
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix

from ..examples import THREE, not_none, scene

SHAPE = (31, 33)
SLOPE = np.hypot(3.0, 2.0)  # grey levels per pixel of f


def camera_of(lens: dict[str, Any]) -> Camera:
    """A camera of one lens type with more keys in its table."""
    described = scene(SHAPE, (("1/3", [2, 2], [9, 9]),))
    tables = described.plain()
    tables["camera"]["lens"][0] |= lens
    return derive(parse(tables, described.source))


def ramp() -> FloatArray:
    """A linear picture: the mean over a rectangle is the value in its middle."""
    rows, columns = np.indices(SHAPE)
    return 3.0 * rows - 2.0 * columns + 100


def inner_error(camera: Camera, picture: FloatArray) -> float:
    """Largest error of the enlarged sub-images, where four of their pixels along both axes lie around a pixel of f."""
    values, worst = ideal_matrix(camera) @ picture.ravel(), 0.0
    rows, columns = (indices.ravel().astype(float) for indices in np.indices(SHAPE))
    for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
        image = values[pixels].reshape(sub.type.pixels)
        found = enlarged(camera, sub, image, np.arange(float(camera.rows))).ravel()
        down, across = positions(camera, sub, rows, columns)
        last_row, last_column = (count - 2 for count in sub.type.pixels)
        inner = (down > 1) & (down < last_row) & (across > 1) & (across < last_column)
        assert inner.sum() > 100
        worst = max(worst, float(np.abs(found - picture.ravel())[inner].max()))
    return worst


@pytest.mark.parametrize("window", [None, [1, "7/2"]], ids=["array", "steered"])
def test_a_linear_picture_is_enlarged_without_an_error(window: list[Any] | None) -> None:
    steered = {} if window is None else {"sub_imager": [{"at": [0, 1], "window": window}]}
    assert inner_error(camera_of(steered), ramp()) < 1e-8


def test_rotation_and_distortion_are_undone() -> None:
    """They move the picture by pixels; a linear one returns to a third of a pixel, of which f's steps are a part."""
    plain = camera_of({})
    rotated = {"sub_imager": [{"at": [0, 0], "window": [2, 2], "rotation": "15 deg"}]}
    for lens in (rotated, {"distortion": [-0.15, 0.0]}):
        camera = camera_of(lens)
        (down, _), (before, _) = (
            positions(each, each.sub_imagers[0], np.full(1, 2.0), np.full(1, 2.0)) for each in (camera, plain)
        )
        assert abs(down - before)[0] * 3 > 1  # pixels of f
        assert inner_error(camera, ramp()) < SLOPE / 3


def test_interpolation_is_that_of_another_library() -> None:
    camera = derive(scene((36, 36), (("1/3", [1, 1], [12, 12]),)))
    image = np.random.default_rng(1).uniform(0, 255, (12, 12)).astype(np.float32)
    other = np.asarray(Image.fromarray(image).resize((36, 36), Image.Resampling.BICUBIC))
    found = enlarged(camera, camera.sub_imagers[0], image.astype(np.float64), np.arange(36.0))
    inner = slice(6, -6)  # at the edges the other one takes fewer pixels
    np.testing.assert_allclose(found[inner, inner], other[inner, inner], atol=1e-3)  # float32


def recorded(noise: dict[str, float]) -> tuple[Stack, FloatArray]:
    """A stack of three lens types; noise : deviation by lens type."""
    described = scene(lenses=THREE)
    camera, truth = derive(described), load(described)
    values, rng = ideal_matrix(camera) @ truth.ravel(), np.random.default_rng(1)
    for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
        values[pixels] += rng.normal(0, noise.get(sub.type.name, 0.0), values[pixels].size)
    return Stack(described, camera, values, np.zeros_like(values), {}), truth


def test_the_best_is_that_with_the_least_error() -> None:
    stack, truth = recorded({})
    best = not_none(best_single_sub_image(stack, truth.ravel()))
    images = zip(stack.camera.sub_imagers, stack.images(), strict=True)
    errors = {
        sub.name: float(np.mean((enlarged(stack.camera, sub, image, np.arange(19.0)) - truth) ** 2))
        for sub, image in images
    }
    assert best.name == min(errors, key=lambda name: errors[name])
    assert sorted(errors.values())[1] > 1.001 * best.mse
    assert best.mse == pytest.approx(errors[best.name])
    assert not_none(best.psnr) == pytest.approx(10 * np.log10(255**2 / np.mean((best.image - truth) ** 2)))
    noisy = not_none(best_single_sub_image(*recorded({"C": 100.0, "B": 100.0})))
    assert (best.name[0], noisy.name[0]) == ("C", "A")


def test_dead_pixels_take_the_value_of_the_nearest() -> None:
    stack, truth = recorded({})
    whole = not_none(best_single_sub_image(stack, truth))
    values = stack.values.copy()
    values[7::25] = np.nan
    dead = not_none(best_single_sub_image(replace(stack, values=values), truth))
    assert np.isfinite(dead.image).all()
    assert whole.mse <= dead.mse < 3 * whole.mse
    nothing = not_none(best_single_sub_image(replace(stack, values=np.full_like(values, np.nan)), truth))
    assert nothing.mse == pytest.approx(float(np.mean(truth**2)))


def test_without_the_truth_there_is_none() -> None:
    assert best_single_sub_image(recorded({})[0], None) is None
