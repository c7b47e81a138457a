"""Kernels of lenses with surfaces as designed: against their entries, at the corner of large fields, and from files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.optics import lens_kernels, lens_matrix
from ommatid.scenes.scene import Scene, read
from ommatid.simulate.ideal import ideal_model

from ..examples import GALLERY
from ..lenses import camera_with
from .test_lens_matrix import BENT

ENTRY = 1e-3  # error of an entry relative to the largest


def large(name: str, size: int, lenses: list[str], detail: int = 1) -> Scene:
    """A scene of the gallery with another target that all lens types fill."""
    changes = [f"camera.lens.{lens}.pixels=fit" for lens in lenses]
    shape = [f"target.shape=[{size},{size}]", f"target.detail={detail}", "calibration.method=ideal"]
    return read(GALLERY / f"{name}.toml", [*shape, *changes], lenses)


@pytest.mark.parametrize(
    ("name", "lenses", "detail"),
    [
        ("doublet", ["III"], 1),
        ("planoconvex", ["I"], 1),
        *(
            pytest.param(name, ["I", "III"], detail, marks=pytest.mark.slow)
            for name, detail in (("doublet", 1), ("planoconvex", 1), ("planoconvex", 3))
        ),
    ],
)
def test_kernels_are_the_entries(name: str, lenses: list[str], detail: int) -> None:
    """On and off the axis, on f's grid and on the world's."""
    camera = derive(large(name, 19, lenses, detail)).world
    for lens_type in camera.types:
        expected = lens_matrix.matrix(camera, lens_type)
        found = lens_kernels.kernels(camera, lens_type).to_sparse()
        assert abs(found - expected).max() < ENTRY * expected.max()
        assert abs(found.sum(axis=1) - expected.sum(axis=1)).max() < ENTRY / 5


def corner(camera: Camera, lens_type: LensType, back: tuple[int, int] = (2, 2)) -> tuple[Camera, LensType]:
    """Two rows and columns of pixels of the last sub-imager alone, `back` before its end, with its lens in place."""
    (down, across), left = lens_type.array, lens_type.left or 0
    window = lens_type.view(down - 1, across - 1).window
    counts = zip(window, lens_type.pixels, back, strict=True)
    first = [start + lens_type.ratio * (count - before) for start, count, before in counts]
    place = {"left": left + across - 1, "above": (down - 1, down)}
    alone = replace(lens_type, array=(1, 1), pixels=(2, 2), origin=(first[0], first[1]), **place)
    return replace(camera, types=(alone,)), alone


@pytest.mark.parametrize(
    ("name", "size"),
    [("doublet", 59), *(pytest.param(name, 119, marks=pytest.mark.slow) for name in ("doublet", "planoconvex"))],
)
def test_kernels_at_the_corner_of_a_large_field(name: str, size: int) -> None:
    camera = derive(large(name, size, ["I"]))
    (lens_type,) = camera.types
    found = lens_kernels.kernels(camera, lens_type).rows(np.array([lens_type.measurements - 1]))
    expected = lens_matrix.matrix(*corner(camera, lens_type))[[3]]
    assert abs(found - expected).max() < ENTRY * expected.max()


@pytest.mark.slow
def test_kernels_between_their_nodes_near_the_corner_of_a_large_field() -> None:
    """Where a rim cuts light off, polynomials of a high degree swing between the positions that they were fitted to."""
    shape = ["target.shape=[239,239]", "target.origin=[0,0]", "target.detail=1", 'camera.lens_pitch="3.15 mm"']
    camera = derive(read(GALLERY / "doublet119.toml", shape))
    lens_type = camera.types[0]
    kernels, (_, across) = lens_kernels.kernels(camera, lens_type), lens_type.pixels
    for back in ((3, 3), (3, 10), (3, 26), (2, 30)):
        pixel = lens_type.measurements - (back[0] - 1) * across - back[1]
        found = kernels.rows(np.array([pixel]))
        expected = lens_matrix.matrix(*corner(camera, lens_type, back))[[0]]
        assert abs(found - expected).max() < 3e-3 * expected.max()


def test_a_large_h_is_kernels_in_a_small_file(tmp_path: Path) -> None:
    scene = large("doublet", 65, ["I"])
    camera = derive(scene)
    model = ideal_model(scene, camera)
    assert model.stored is None
    image, readings = (np.random.default_rng(seed).normal(size=size) for seed, size in ((1, 4225), (2, 3969)))
    assert readings @ model.forward(image) == pytest.approx(model.adjoint(readings) @ image, rel=1e-9)
    model_file.write(tmp_path / "model.npz", model)
    assert (tmp_path / "model.npz").stat().st_size < 1e5
    again = model_file.read(tmp_path / "model.npz")
    assert again.stored is None
    np.testing.assert_array_equal(again.forward(image), model.forward(image))
    assert again.errors(image) is None
    rows = model.to_sparse()
    np.testing.assert_allclose(model.forward(image), rows @ image, atol=1e-10)


@pytest.mark.slow
def test_distortion_that_kernels_do_not_hold_is_named() -> None:
    camera = camera_with(BENT)
    wide = replace(camera.types[0], pixels=(160, 160), array=(1, 1), origin=(-240, -240))
    with pytest.raises(InputError, match="displaced and blurred over the field by more than kernels hold"):
        lens_kernels.kernels(replace(camera, types=(wide,)), wide)
