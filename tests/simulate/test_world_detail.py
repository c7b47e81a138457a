"""Worlds finer than f: the picture, what is rendered of it, and the files of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.reconstruct.output.result_files import truth_beside
from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file, stack
from ommatid.scenes.formats import exr
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene, write
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import ideal_matrix
from tests.conftest import Command
from tests.examples import needs, scene, with_optics
from tests.simulate.world_files import assert_rendered

SMALL = (("1/3", [3, 3], [3, 3]), ("1/2", [2, 2], [5, 5]))


def detailed(detail: int, **tables: object) -> Scene:
    """A distorted camera in front of a world `detail` times finer than 11 x 11 pixels of f."""
    target = {"detail": detail}
    return with_optics({"distortion": [0.3, 0]}, {"lens_pitch": "3 mm"}, SMALL, (11, 11), target=target, **tables)[0]


def test_pictures_are_used_at_their_own_resolution() -> None:
    fine, coarse = Setup.from_scene(detailed(4)), Setup.from_scene(scene(shape=(44, 44), lenses=SMALL))
    np.testing.assert_array_equal(fine.picture, coarse.picture)
    assert fine.camera.shape == fine.image.shape == (11, 11)
    np.testing.assert_allclose(fine.image[2, 3], fine.picture[8:12, 12:16].mean(), rtol=1e-12)


def test_a_picture_too_small_for_the_detail_is_refused() -> None:
    large = detailed(16)
    large = large.model_copy(update={"target": large.target.model_copy(update={"shape": (44, 44)})})
    with pytest.raises(InputError, match=r"704 x 704 pixels at \[96, 224\] is empty or leaves .* at most \[32, 32\]"):
        load(large)


def test_a_finer_world_describes_the_same_camera() -> None:
    """Lengths do not change, and a world made of f's pixels gives the measurements of f."""
    camera = Setup.from_scene(detailed(3)).camera
    world = camera.world
    for coarse, fine in zip(camera.sub_imagers, world.sub_imagers, strict=True):
        assert fine.patch == pytest.approx(coarse.patch, rel=1e-12)
        assert fine.depth == pytest.approx(coarse.depth, rel=1e-12)
    image = np.random.default_rng(0).uniform(0, 255, (11, 11))
    repeated = np.kron(image, np.ones((3, 3)))
    of_pixels = ideal_matrix(replace(camera, detail=1)) @ image.ravel()
    np.testing.assert_allclose(ideal_matrix(world) @ repeated.ravel(), of_pixels, rtol=1e-7)


def test_the_fine_picture_is_rendered() -> None:
    needs("llvm_ad_mono")
    setup = Setup.from_scene(detailed(4, render={"samples": 4096}))
    rendering, exact = assert_rendered(setup), ideal_matrix(setup.world.camera) @ setup.world.image.ravel()
    blurred = ideal_matrix(replace(setup.camera, detail=1)) @ setup.image.ravel()
    assert np.abs(blurred - exact).max() > 10 * np.abs(rendering.mean - exact).max(), (
        "detail is seen: 12.7 for the worst of 12 seeds"
    )


@pytest.mark.parametrize("method", ["transport", "points"])
def test_h_is_learnt_on_the_grid_of_the_world(method: str) -> None:
    needs("llvm_ad_mono")
    setup = Setup.from_scene(detailed(2, calibration={"method": method, "samples": 1024}))
    model = calibrate(setup)
    assert model.matrix.shape == (setup.camera.measurements, 22 * 22)
    assert model.record["agreement"]["p_value"] > 1e-3  # with H in closed form on the same grid


@pytest.mark.slow
def test_the_folder_of_a_run_holds_the_picture_and_its_average(ommatid: Command, tmp_path: Path) -> None:
    needs("llvm_ad_mono")
    tables = {"noise": {"variance": 1e-2}, "prior": {"kind": "exponential", "correlation_length": "25 mm"}}
    path = tmp_path / "fine.toml"
    write(path, detailed(2, calibration={"method": "ideal"}, render={"samples": 256}, **tables))
    assert ommatid("run", path, "-o", tmp_path / "out").code == 0
    folder = tmp_path / "out" / "fine"
    world, truth = (exr.read(folder / name)[0].channels["Y"] for name in ("target.exr", "truth.exr"))
    assert world.shape == (22, 22)
    np.testing.assert_allclose(truth, world.reshape(11, 2, 11, 2).mean(axis=(1, 3)), rtol=1e-6)
    recorded = stack.read(folder / "stack.exr")
    known = truth_beside(folder / "stack.exr", recorded)
    assert known is not None
    assert known.size == 22 * 22
    assert model_file.read(folder / "model.npz").unknowns == 22 * 22
    again = ommatid("run", folder / "scene.toml", "-o", tmp_path / "again")
    assert again.code == 0, again.err
    for name in ("stack.exr", "estimate.exr"):
        first, second = (exr.read(place / name) for place in (folder, tmp_path / "again" / "scene"))
        for one, other in zip(first, second, strict=True):
            for channel, pixels in one.channels.items():
                np.testing.assert_array_equal(pixels, other.channels[channel])


def test_a_model_on_another_grid_is_refused(ommatid: Command, tmp_path: Path) -> None:
    needs("llvm_ad_mono")
    path, model = tmp_path / "fine.toml", tmp_path / "model.npz"
    write(path, detailed(2, calibration={"method": "ideal"}, render={"samples": 16}))
    assert ommatid("render", path, "-o", tmp_path).code == 0
    other = ("--set", "target.detail=3")
    assert ommatid("calibrate", path, "-o", model, *other).code == 0
    ended = ommatid("reconstruct", tmp_path / "fine" / "stack.exr", model, "-o", tmp_path / "estimate.exr")
    assert ended.code == 2
    assert "need H on 22 x 22 pixels, " in ended.err
    assert "model.npz has 33 x 33" in ended.err
