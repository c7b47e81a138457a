"""Sub-imagers with windows and orientations of their own, and arrays with other steps down than across."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.hardware.point_sources import unrecorded
from ommatid.scenes.scene import Scene, parse, read, write
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import GALLERY, needs, scene, slow, with_keys
from ..frames import assert_acts_as, assert_methods_agree, assert_window, observed
from ..runs import document
from ..simulate.world_files import assert_rendered

FINE = 12  # cells of a pixel of f, so that edges of footprints lie on edges of cells
WINDOWS: dict[tuple[int, int], tuple[Any, Any]] = {(0, 0): (0, 0), (0, 2): ("3/2", 9), (1, 1): (8, "17/4")}
ANGLE = 0.1


def described(first: dict[str, Any], shape: tuple[int, int] = (20, 18), **tables: Any) -> Scene:
    """Two lens types, the first with these keys."""
    data = scene(shape, (("1/3", [2, 3], [3, 3]), ("1/2", [2, 2], [6, 6])), **tables).plain()
    data["camera"]["lens"][0] |= first
    return parse(data, Path("test.toml"))


def steered(named: dict[tuple[int, int], dict[str, Any]], more: Any = None, **tables: Any) -> Scene:
    """These sub-imagers of the first lens type are off its grid."""
    return described({"sub_imager": [{"at": list(at), **keys} for at, keys in named.items()], **(more or {})}, **tables)


def windows(**tables: Any) -> Scene:
    return steered({at: {"window": list(window)} for at, window in WINDOWS.items()}, **tables)


def by_counting(camera: Camera, first: dict[tuple[int, int], tuple[Any, Any]]) -> FloatArray:
    """Return H by counting cells of windows that are written out here; first : those of the first lens type."""
    blocks = [(window, 3, 3) for window in first.values()]
    blocks += [((3 + k, 2 + l), 2, 6) for k, l in np.ndindex(2, 2)]  # noqa: E741
    rows: list[FloatArray] = []
    for window, ratio, count in blocks:
        top, left = (int(Fraction(number) * FINE) for number in window)
        for i, j in np.ndindex(count, count):
            side = ratio * FINE
            cells = np.zeros((camera.rows * FINE, camera.columns * FINE))
            cells[top + i * side : top + (i + 1) * side, left + j * side : left + (j + 1) * side] = 1 / side**2
            rows.append(cells.reshape(camera.rows, FINE, camera.columns, FINE).sum(axis=(1, 3)).ravel())
    return np.array(rows)


def test_pixels_seen_by_a_rotated_window_are_those_whose_whole_light_is_in_h() -> None:
    data = scene((20, 18), (("1/3", [1, 1], [5, 2]),)).plain()
    data["camera"]["lens"][0]["sub_imager"] = [{"at": [0, 0], "rotation": "20 deg"}]
    camera = derive(parse(data, Path("test.toml")))
    share = np.asarray(ideal_matrix(camera).sum(axis=0)) * 3**2  # of each pixel of f
    whole = (share > 1 - 1e-9).reshape(camera.shape)
    assert 40 < whole.sum() < share.sum() == pytest.approx(5 * 2 * 3**2)
    np.testing.assert_array_equal(camera.types_seeing(), whole)


GRID = list(np.ndindex(2, 3))
STEPS = {  # of the array, and where its first window is, so that all of them lie in the middle
    "[2, 1]": (4, 3),
    "[1, 2]": (5, 2),
    '["1/2", 2]': (5, 2),
    '[0, "3/4"]': (5, 4),
}


@pytest.mark.parametrize("step", [None, *STEPS])
def test_h_is_that_of_counted_cells(step: str | None) -> None:
    """Of sub-imagers whose windows are named, and of windows that are shifted by other numbers down than across."""
    if step is None:
        camera, first = derive(windows()), {(k, l): (5 + k, 3 + l) for k, l in GRID} | WINDOWS  # noqa: E741
    else:
        camera, (down, across) = derive(described({"step": json.loads(step)})), map(Fraction, json.loads(step))
        top, left = STEPS[step]
        first = {(k, l): (top + k * down, left + l * across) for k, l in GRID}  # noqa: E741
        assert camera.types[0].step == (down, across)
    counted = by_counting(camera, first)
    np.testing.assert_allclose(ideal_matrix(camera).toarray(), counted, atol=1e-14)
    assert_acts_as(observed(camera), counted)
    outside = np.ones(camera.shape)
    outside[2:15, 1:16] = 0
    inside = assert_window(observed(camera), counted, slice(2, 15), slice(1, 16))
    assert inside == np.flatnonzero(counted @ outside.ravel() == 0).tolist()
    some = sum((counted[part].sum(axis=0) > 1e-9).astype(int) for part in camera.type_slices())
    np.testing.assert_array_equal(unrecorded(camera, np.zeros((0, 2), dtype=np.int64)), np.flatnonzero(some))


def test_h_of_a_rotated_sub_imager_is_that_of_points_in_its_pixels() -> None:
    count, camera = 200, derive(steered({(1, 2): {"window": [6, 5], "rotation": f"{ANGLE} rad"}}))
    at = (np.arange(3 * count) + 0.5) / count * 3 - 4.5
    b, a = np.meshgrid(at, at, indexing="ij")
    row = np.floor(6 + 4.5 + np.sin(ANGLE) * a + np.cos(ANGLE) * b).astype(int)
    column = np.floor(5 + 4.5 + np.cos(ANGLE) * a - np.sin(ANGLE) * b).astype(int)
    expected = np.zeros((9, camera.unknowns))
    pixel = np.add.outer(np.arange(3 * count) // count * 3, np.arange(3 * count) // count)
    np.add.at(expected, (pixel, row * camera.columns + column), 1 / count**2)
    # Points at a distance of 1/200 of a pixel miss an edge by half of that at most, over the length of an edge.
    np.testing.assert_allclose(ideal_matrix(camera).toarray()[45:54], expected, atol=1 / count)
    assert np.abs(ideal_matrix(derive(windows())).toarray()[45:54] - expected).max() > 0.05


OPTICS: dict[str, dict[str, Any]] = {
    "pinhole": {},
    "out of focus": {"aperture": "0.4 mm", "focus": "950 mm"},
    "distorted": {"distortion": [0.03, 0.01]},
}


@pytest.mark.parametrize(
    ("variant", "optics", "rotation"),
    [
        ("llvm_ad_mono", "pinhole", "5 deg"),
        slow("scalar_rgb", "pinhole", None),
        *(slow("llvm_ad_mono", name, None) for name in OPTICS),
        slow("llvm_ad_mono", "distorted", "5 deg"),
    ],
)
def test_rendered_against_the_closed_form(variant: str, optics: str, rotation: str | None) -> None:
    needs(variant)
    named: dict[tuple[int, int], dict[str, Any]] = {
        (0, 0): {"window": [2, 1]},
        (0, 2): {"window": ["7/2", 8]},
        (1, 1): {"window": [8, "17/4"]},
    }
    if rotation is not None:
        named[1, 1]["rotation"] = rotation
    render = {"variant": variant, "samples": 4096, "complete": True}
    setup = Setup.from_scene(steered(named, more=OPTICS[optics], render=render))
    assert_rendered(setup)


@pytest.mark.parametrize(("method", "rotation"), [("transport", "5 deg"), slow("points", None)])
def test_calibrated_against_the_closed_form(method: str, rotation: str | None) -> None:
    """Entry by entry, by the variance that the calibration states from its batches."""
    needs("llvm_ad_mono")
    tables: dict[str, Any] = {"render": {"variant": "llvm_ad_mono"}, "calibration": {"samples": 1024, "method": method}}
    named: dict[tuple[int, int], dict[str, Any]] = {(0, 2): {"window": [2, 8]}, (1, 1): {"window": [8, "17/4"]}}
    if rotation is not None:
        named[1, 1]["rotation"] = rotation
    setup = Setup.from_scene(steered(named, **tables))
    model = calibrate(setup)
    difference = np.asarray((model.matrix - ideal_matrix(setup.camera)).toarray())
    assert np.abs(difference).max() < 5 * np.sqrt(model.variance.max()) < 0.03, "entries are 1/9 and 1/4"


ESTIMATED: dict[str, tuple[tuple[int, int], dict[str, Any], tuple[str, ...], int]] = {
    "windows": ((20, 18), {"sub_imager": [{"at": [0, 0], "window": [0, 0]}]}, ("tiles", "frame"), 20),
    "rotated": ((20, 18), {"sub_imager": [{"at": [1, 2], "window": [8, "17/4"], "rotation": "5 deg"}]}, ("frame",), 20),
    "steps": ((24, 23), {"step": [2, 1], "array": [3, 3], "pixels": "fit"}, ("frame", "tiles"), 52),
}


@pytest.mark.parametrize("kind", ESTIMATED)
def test_frames_and_tiles_agree_with_the_dense_estimate(kind: str) -> None:
    shape, first, methods, size = ESTIMATED[kind]

    def by(method: str) -> Scene:
        estimator, tiles = {"method": method, "accuracy": 1e-6}, {"size": size, "overlap": 0}
        made = described(first, shape, noise={"variance": 1e-2}, estimator=estimator, tiles=tiles)
        return with_keys(made, camera={"lens_pitch": 50.0})

    assert_methods_agree(by, methods, 1e-3)


def whole_tile() -> Scene:
    """The paper's 19 x 19 tile, in which the nine lenses of type I look further apart, and one is turned."""
    data = read(GALLERY / "tile19.toml").plain()
    windows: list[dict[str, Any]] = [{"at": [k, l], "window": [2 * k, 2 * l]} for k in range(3) for l in range(3)]  # noqa: E741
    windows[4] |= {"rotation": "2 deg"}
    data["camera"]["lens"][0]["sub_imager"] = windows
    return parse(
        data | {"noise": {"variance": 0.1}, "calibration": {"method": "transport", "samples": 4096}}, Path("test")
    )


@pytest.mark.slow
def test_a_camera_of_steered_windows_from_scene_file_to_verdict(tmp_path: Path, ommatid: Command) -> None:
    needs("llvm_ad_mono")
    write(tmp_path / "steered.toml", whole_tile())
    ended = ommatid("run", tmp_path / "steered.toml", "-o", tmp_path / "out", "--json")
    assert ended.code == 0
    (report,) = document(ended)
    assert report["verdict"]["trusted"], report["verdict"]
    given = report["error"]["expected_given_truth"]
    assert given["low"] < report["error"]["mse"] < given["high"]


def test_one_number_is_described_as_before_and_two_are_told_apart() -> None:
    same = [derive(described({"step": step})).describe()["camera.lens.A"]["step"] for step in (1, "1", [1, 1])]
    assert same == ["1"] * 3
    assert described({"step": ["1/2", "1/2"]}).plain()["camera"]["lens"][0]["step"] == "1/2"
    assert derive(described({"step": [2, 1]})).describe() != derive(described({"step": [1, 2]})).describe()


@pytest.mark.parametrize(
    "first",
    [
        {"sub_imager": [{"at": [0, 2], "window": ["3/2", 9], "rotation": "-1 deg"}]},
        *({"step": step} for step in (2, [2, 1], ["1/2", 2])),
    ],
)
def test_written_and_read_again(first: dict[str, Any], tmp_path: Path) -> None:
    before = described(first)
    write(tmp_path / "scene.toml", before)
    assert derive(read(tmp_path / "scene.toml")).types[0] == derive(before).types[0]
    assert read(tmp_path / "scene.toml", ["camera.lens.A.step=[3, 1]"]).camera.lens[0].step == (3, 1)


def test_the_array_fits_the_target_along_either_axis() -> None:
    camera = derive(described({"step": [4, 1], "pixels": "fit", "array": [3, 3]}, (20, 17)))
    assert camera.types[0].pixels == ((20 - 8) // 3, (17 - 2) // 3)
    assert camera.types[0].span == (20, 17)


def test_patches_that_a_window_moves_onto_each_other_are_refused() -> None:
    """A view 110 pixels further right moves a patch by 110/3 sensor pixels of 6 um to the left: 0.22 mm of 0.3 mm."""
    lens = (("1/3", [1, 2], [20, 20]),)
    data = scene((60, 300), lens).plain()
    data["target"]["origin"] = [96, 96]
    data["camera"]["lens_pitch"] = "0.3 mm"
    derive(parse(data, Path("test.toml")))
    data["camera"]["lens"][0]["sub_imager"] = [{"at": [0, 1], "window": [0, 230]}]
    with pytest.raises(InputError, match=r"A\.00\.00 and A\.00\.01 overlap"):
        derive(parse(data, Path("test.toml")))
    data["camera"]["lens"][0]["sub_imager"] = [{"at": [0, 0], "window": [0, 230]}]
    derive(parse(data, Path("test.toml")))
