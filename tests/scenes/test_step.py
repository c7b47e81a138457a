"""Windows that are shifted by another number of pixels down than across."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.hardware.point_sources import unrecorded
from ommatid.scenes.scene import Scene, parse, read, write
from ommatid.simulate.ideal import ideal_matrix

from ..examples import scene
from ..frames import assert_methods_agree, observed


def stepped(step: Any, shape: tuple[int, int] = (20, 17), more: dict[str, Any] | None = None, **tables: Any) -> Scene:
    """Two lens types, the first with this step."""
    data = scene(shape, (("1/3", [2, 3], [4, 3]), ("1/2", [2, 2], [6, 6])), **tables).plain()
    data["camera"]["lens"][0] |= {"step": step, **(more or {})}
    return parse(data, Path("test.toml"))


def by_counting(camera: Camera) -> FloatArray:
    """Return H by counting cells of a grid so fine that all edges of footprints and of pixels lie on it."""
    fine, rows = 12, []
    for lens_type in camera.types:
        side = int(lens_type.ratio * fine)
        for k, l in np.ndindex(*lens_type.array):  # noqa: E741
            first = [
                int((origin + index * step) * fine)
                for origin, index, step in zip(lens_type.origin, (k, l), lens_type.step, strict=True)
            ]
            for i, j in np.ndindex(*lens_type.pixels):
                cells = np.zeros((camera.rows * fine, camera.columns * fine))
                top, left = first[0] + i * side, first[1] + j * side
                cells[top : top + side, left : left + side] = 1 / side**2
                rows.append(cells.reshape(camera.rows, fine, camera.columns, fine).sum(axis=(1, 3)).ravel())
    return np.array(rows)


@pytest.mark.parametrize("step", [[2, 1], [1, 2], ["1/2", 2], [0, "3/4"]])
def test_h_is_that_of_counted_cells(step: list[Any]) -> None:
    camera = derive(stepped(step))
    assert camera.types[0].step == (Fraction(step[0]), Fraction(step[1]))
    counted = by_counting(camera)
    np.testing.assert_allclose(ideal_matrix(camera).toarray(), counted, atol=1e-14)
    boxes, rng = observed(camera), np.random.default_rng(0)
    image, readings = rng.normal(size=camera.unknowns), rng.normal(size=camera.measurements)
    np.testing.assert_allclose(boxes.forward(image), counted @ image, atol=1e-12)
    np.testing.assert_allclose(boxes.adjoint(readings), counted.T @ readings, atol=1e-12)
    seen = sum((counted[part].sum(axis=0) > 1e-9).astype(int) for part in camera.type_slices())
    np.testing.assert_array_equal(unrecorded(camera, np.zeros((0, 2), dtype=np.int64)), np.flatnonzero(seen))


@pytest.mark.parametrize("shape", [(24, 23), (32, 30)])
def test_frames_and_tiles_agree_with_the_dense_estimate(shape: tuple[int, int]) -> None:
    def described(method: str) -> Scene:
        settings = {
            "noise": {"variance": 1e-2},
            "estimator": {"method": method, "accuracy": 1e-6},
            "tiles": {"size": 52, "overlap": 0},
        }
        scene = stepped([2, 1], shape, {"array": [3, 3], "pixels": "fit"}, **settings)
        return scene.model_copy(update={"camera": scene.camera.model_copy(update={"lens_pitch": 50.0})})

    assert_methods_agree(described, ("frame", "tiles"), 1e-4)


def test_one_number_is_described_as_before_and_two_are_told_apart() -> None:
    same = [derive(stepped(step)).describe()["camera.lens.A"]["step"] for step in (1, "1", [1, 1])]
    assert same == ["1"] * 3
    assert stepped(["1/2", "1/2"]).plain()["camera"]["lens"][0]["step"] == "1/2"
    assert derive(stepped([2, 1])).describe() != derive(stepped([1, 2])).describe()


@pytest.mark.parametrize("step", [2, [2, 1], ["1/2", 2]])
def test_written_and_read_again(step: Any, tmp_path: Path) -> None:
    before = stepped(step)
    write(tmp_path / "scene.toml", before)
    assert read(tmp_path / "scene.toml").camera.lens[0].step == before.camera.lens[0].step
    assert read(tmp_path / "scene.toml", ["camera.lens.A.step=[3, 1]"]).camera.lens[0].step == (3, 1)


def test_the_array_fits_the_target_along_either_axis() -> None:
    camera = derive(stepped([4, 1], more={"pixels": "fit", "array": [3, 3]}))
    assert camera.types[0].pixels == ((20 - 8) // 3, (17 - 2) // 3)
    assert camera.types[0].span == (20, 17)
