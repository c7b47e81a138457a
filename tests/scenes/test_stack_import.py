"""Frames of a real camera become stacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.scenes import model_file, stack
from ommatid.scenes.camera import Camera
from ommatid.scenes.hardware.frames import patches, stored_pictures
from ommatid.scenes.model import Model
from ommatid.scenes.scene import read
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from ..conftest import Command, Ended
from ..examples import not_none
from .mosaics import SCENE, SENSOR, SHAPE, Array, as_mosaic, assert_error_as_expected, recorded_image, save


def imported(ommatid: Command, *arguments: str | Path) -> tuple[Stack, Ended]:
    """The stack that a command makes of pictures, and the command's output."""
    ended = ommatid("import", "scene.toml", *arguments, "-o", "s.exr")
    assert ended.code == 0, ended.err
    return stack.read(Path("s.exr")), ended


@pytest.mark.parametrize(
    ("name", "dtype", "step"),
    [("m.png", np.uint16, 1), ("m.tiff", np.uint16, 1), ("m.npy", np.float64, 0), ("m.exr", np.float32, 0)],
)
def test_a_mosaic_is_cut_up(imaging_camera: Camera, ommatid: Command, name: str, dtype: type[Any], step: int) -> None:
    _, values = recorded_image(imaging_camera)
    values = np.rint(values + 1000) if step else values.astype(np.float32).astype(np.float64)
    mosaic = save(Path(name), as_mosaic(imaging_camera, values).astype(dtype))
    cut, ended = imported(ommatid, mosaic, "--json")
    np.testing.assert_array_equal(cut.values, values.astype(np.float32))
    assert not cut.rendering_variance.any()
    described = json.loads(ended.out)
    assert described["method"] == "imported"
    assert [source["name"] for source in described["source"]] == [name]
    assert "beside whole pixels" in ended.err


def test_letters_on_the_sensor_become_upright(ommatid: Command) -> None:
    """Worked by hand: four lenses 20 pixels apart see the same point, so their patches are slightly further apart.

    The letters are upside down on the sensor, and the one at the top left is that of sub-imager (0, 0).
    """
    letter = np.array([[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0]], dtype=np.uint8)
    scene = f"""{SCENE.partition("[[camera.lens]]")[0].replace("0.064 mm", "0.12 mm").replace("[12, 14]", "[10, 8]")}
[[camera.lens]]
name = "A"
magnification = "1/2"
array = [2, 2]
pixels = [5, 4]
step = 0
"""
    Path("scene.toml").write_text(scene, encoding="utf-8")
    mosaic = np.zeros((50, 60), dtype=np.uint8)
    expected: list[Array] = []
    for number, (row, column) in enumerate([(15, 20), (15, 40), (35, 20), (35, 40)]):
        image = letter * (number + 1)
        # Patches of 5 x 4 pixels around (15 - 0.03, 20 - 0.03) and so on: rows 12.47 to 17.47, columns 17.97 to 21.97.
        top = {15: 12, 35: 33}[row]
        mosaic[top : top + 5, column - 2 : column + 2] = image[::-1, ::-1]
        expected.append(image)
    picture = save(Path("m.png"), mosaic)
    np.testing.assert_array_equal(imported(ommatid, picture)[0].images(), expected)
    np.testing.assert_array_equal(
        imported(ommatid, picture, "--upright")[0].images(), np.array(expected)[:, ::-1, ::-1]
    )


def test_the_origin_is_the_corner_of_the_first_patch(imaging_camera: Camera, ommatid: Command) -> None:
    _, values = recorded_image(imaging_camera)
    mosaic = as_mosaic(imaging_camera, values)
    nearest = np.floor(patches(imaging_camera) + np.array(SHAPE) / 2 + 0.5).astype(int)
    top, left = nearest.min(axis=0).tolist()
    save(Path("cut.npy"), mosaic[top:, left:])
    row, column = (nearest[0] - nearest.min(axis=0)).tolist()
    cut, ended = imported(ommatid, "cut.npy", "--origin", f"{row},{column}", "--json")
    exact = patches(imaging_camera) - patches(imaging_camera)[0]
    beside = np.abs(exact - np.rint(exact)).max()
    assert json.loads(ended.out)["beside_pixels"] == pytest.approx(beside, abs=1e-9)
    np.testing.assert_array_equal(cut.images()[0].ravel(), values[imaging_camera.slices()[0]].astype(np.float32))


def test_single_pictures_are_in_the_order_of_measurements(imaging_camera: Camera, ommatid: Command) -> None:
    _, values = recorded_image(imaging_camera)
    pairs = zip(imaging_camera.sub_imagers, imaging_camera.slices(), strict=True)
    upright = [values[pixels].reshape(sub.type.pixels) for sub, pixels in pairs]
    names = [save(Path(f"p{number:02d}.npy"), picture) for number, picture in enumerate(upright)]
    Path("turned").mkdir()
    for number, picture in enumerate(upright):
        save(Path(f"turned/{number:02d}.npy"), picture[::-1, ::-1])
    for pictures in (names, ["turned", "--turned"]):
        made, ended = imported(ommatid, *pictures)
        assert "beside" not in ended.err
        np.testing.assert_array_equal(made.values, values.astype(np.float32))


def test_dark_and_flat_frames_remove_offsets_and_gains_of_pixels(imaging_camera: Camera, ommatid: Command) -> None:
    rng = np.random.default_rng(2)
    _, values = recorded_image(imaging_camera)
    gain, offset = rng.uniform(5, 9, values.size), rng.uniform(100, 200, values.size)
    spread = rng.normal(0, 3, (2, values.size))
    spread -= spread.mean(axis=0)  # the mean of two frames is exact
    for number in (0, 1):
        save(Path(f"dark{number}.npy"), as_mosaic(imaging_camera, offset + spread[number]))
        save(Path(f"flat{number}.npy"), as_mosaic(imaging_camera, offset + 200 * gain + spread[number]))
    save(Path("image.npy"), as_mosaic(imaging_camera, offset + gain * values))
    files = ["--dark", "dark0.npy", "--dark", "dark1.npy", "--flat", "flat0.npy", "--flat", "flat1.npy"]
    made, _ = imported(ommatid, "image.npy", *files, "--flat-value", "200")
    np.testing.assert_allclose(made.values, values, rtol=1e-5, atol=1e-3)
    made, _ = imported(ommatid, "image.npy", "--dark", "dark0.npy")
    np.testing.assert_allclose(made.values, gain * values - spread[0], rtol=1e-5, atol=1e-3)


def test_pixels_with_a_flat_not_above_the_dark_are_dead(imaging_camera: Camera, ommatid: Command) -> None:
    _, values = recorded_image(imaging_camera)
    dark, flat = np.full(values.size, 10.0), np.full(values.size, 265.0)
    flat[3], flat[70], dark[90] = 10.0, np.nan, 300.0
    for name, numbers in (("image", 10 + values), ("dark", dark), ("flat", flat)):
        save(Path(f"{name}.npy"), as_mosaic(imaging_camera, numbers))
    made, ended = imported(ommatid, "image.npy", "--dark", "dark.npy", "--flat", "flat.npy")
    assert "3 sensor pixels are dead" in ended.err
    assert np.flatnonzero(np.isnan(made.values)).tolist() == [3, 70, 90]


def test_with_a_sensor_the_stack_holds_digital_numbers(imaging_camera: Camera, ommatid: Command) -> None:
    lensed = SCENE.replace("pixels =", 'aperture = "0.06 mm"\npixels =')
    Path("scene.toml").write_text(lensed + SENSOR, encoding="utf-8")
    _, values = recorded_image(imaging_camera)
    digital = np.clip(np.rint(100 + 7 * values), 0, 4094)
    for name, numbers in (("image", digital), ("dark", 100), ("flat", 100 + 7 * 255)):
        pixels = as_mosaic(imaging_camera, np.broadcast_to(np.float64(numbers), values.shape), outside=100)
        save(Path(f"{name}.png"), pixels.astype(np.uint16))
    frames = ["--dark", "dark.png", "--flat", "flat.png"]
    made = imported(ommatid, "image.png", *frames)[0]
    np.testing.assert_array_equal(not_none(made.recording).digital, digital)
    np.testing.assert_allclose(made.values, (digital - 100) / 7)
    again = imported(ommatid, "image.png", *frames, *frames)[0]
    assert [not_none(each.recording).sensor.frames for each in (made, again)] == [50, 2]
    ended = ommatid("import", "scene.toml", "image.png", "-o", "s.exr")
    assert ended.code == 2
    assert "--dark" in ended.err


def test_an_imported_stack_is_reconstructed_with_the_predicted_error(imaging_camera: Camera, ommatid: Command) -> None:
    image, values = recorded_image(imaging_camera)
    save(Path("m.npy"), as_mosaic(imaging_camera, values))
    imported(ommatid, "m.npy")
    scene = read(Path("scene.toml"))
    made = ideal_model(scene, imaging_camera)
    record = {"method": "ideal", "versions": {}, "seconds": 0.0}
    model_file.write(Path("h.npz"), Model(scene, imaging_camera, made.stored, made.variance, made.batches, record))
    ended = ommatid("reconstruct", "s.exr", "h.npz", "-o", "e.exr", "--json")
    assert ended.code == 0, ended.err
    described = json.loads(ended.out)
    assert described["seeds"] == {"scene": None, "data": None, "calibration": None}
    assert described["stages"]["render"]["method"] == "imported"
    assert_error_as_expected(image, Path("e.exr"), described["error"]["predicted_mse"])
    ended = ommatid("reconstruct", "s.exr", "h.npz", "-o", "e.exr", "-v")
    assert "│ import " in ended.out


PLACES = {
    "twice": "image,row,column\nm.npy,0,0\n0,0,0",
    "close": "image,row,column\nm.npy,5,5\n0,6,6",
    "few": "image,row,column\n0,0,0",
}


def write_files() -> None:
    """Write the files, many of them wrong, of the commands below."""
    save(Path("m.npy"), np.zeros(SHAPE))
    save(Path("ones.npy"), np.ones(SHAPE))
    save(Path("small.npy"), np.zeros((20, 30)))
    save(Path("dark.npy"), np.zeros((42, 61)))
    save(Path("three.npy"), np.zeros((3, *SHAPE)))
    for name, text in PLACES.items():
        Path(f"{name}.csv").write_text(text + "\n", encoding="utf-8")


IMPORT, CALIBRATE = ("import", "scene.toml", "-o", "new.exr"), ("calibrate", "scene.toml", "-o", "new.npz", "--points")


SMALL = ["small.npy"] * 13


WRONG: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    ((*IMPORT, "small.npy"), ("small.npy", "I.00.00", "20 x 30", "--origin")),
    ((*IMPORT, "m.npy", "--origin", "30,30"), ("leaves the mosaic", "42 x 62")),
    ((*IMPORT, "three.npy"), ("13 pictures", "got 3")),
    ((*IMPORT, *SMALL), ("small.npy", "5 x 6", "20 x 30")),
    ((*IMPORT, "m.npy", "--dark", "ones.npy", "--flat", "m.npy"), ("228 of 228 sensor pixels; exchange the two",)),
    ((*IMPORT, "m.npy", "--flat", "dark.npy"), ("dark.npy", "42 x 62", "42 x 61")),
    (("import", "scene.toml", "m.npy", "-o", "m.npy"), ("m.npy", "expected the name of a stack")),
    ((*CALIBRATE, "m.npy"), ("168 pixels", "got 1", "--places")),
    ((*CALIBRATE, "m.npy", "--places", "twice.csv"), ("line 3", "twice")),
    ((*CALIBRATE, "m.npy", "--places", "close.csv"), ("m.npy", "(5, 5)", "(6, 6)", "two images")),
    ((*CALIBRATE, "m.npy", "--places", "few.csv"), ("few.csv", "row 0, column 1")),
    (("calibrate", "scene.toml", "-o", "new.npz", "--places", "few.csv"), ("--points",)),
]


@pytest.mark.usefixtures("imaging_camera")
def test_wrong_input_is_refused_in_one_sentence(ommatid: Command) -> None:
    write_files()
    before = {path: path.stat().st_mtime_ns for path in Path().iterdir()}
    for arguments, words in WRONG:
        ended = ommatid(*arguments)
        assert ended.code == 2, ended.err
        assert len(ended.err.splitlines()) == 1, ended.err
        for word in words:
            assert word in ended.err, ended.err
    assert {path: path.stat().st_mtime_ns for path in Path().iterdir()} == before


def test_what_is_missing_or_turned_gives_a_warning(imaging_camera: Camera, ommatid: Command) -> None:
    _, values = recorded_image(imaging_camera)
    save(Path("m.npy"), as_mosaic(imaging_camera, np.abs(values) + 20, outside=10.0))
    save(Path("turned.npy"), np.load("m.npy")[::-1, ::-1])
    save(Path("dark.npy"), np.full(SHAPE, 10.0))
    save(Path("flat.npy"), np.full(SHAPE, 265.0))
    both = "--dark", "dark.npy", "--flat", "flat.npy"
    commands = {("m.npy", *both): "", ("turned.npy", *both): "turned by 180 degrees, the mosaic has"}
    commands |= {("m.npy", *both[:2]): "--dark without --flat", ("m.npy", *both[2:]): "--flat without --dark"}
    for arguments, words in commands.items():
        said = imported(ommatid, *arguments)[1].err
        assert said.count("warning") == 1 + bool(words), said  # one on the places of the sub-images
        assert words in said


def test_a_restricted_import_still_has_all_types_on_the_sensor(imaging_camera: Camera, ommatid: Command) -> None:
    _, values = recorded_image(imaging_camera)
    save(Path("m.npy"), as_mosaic(imaging_camera, values))
    expected = values[imaging_camera.type_slices()[1]].astype(np.float32)
    np.testing.assert_array_equal(imported(ommatid, "m.npy", "--lens", "II")[0].values, expected)


def test_a_colour_array_is_one_picture(tmp_path: Path) -> None:
    np.save(tmp_path / "colour.npy", np.zeros((20, 30, 3), dtype=np.uint8))
    assert [stored.pixels.shape for stored in stored_pictures(tmp_path / "colour.npy", "images")] == [(20, 30, 3)]
