"""Recorded frames of a real camera become stacks, and recorded point sources H, as the geometry says."""

from __future__ import annotations

import json
from dataclasses import replace
from math import floor
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse, stats
from skimage import io

from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file, stack
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats import exr
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.hardware import point_sources
from ommatid.scenes.hardware.frames import AcquisitionSettings, patches, pictures_of, read_frames
from ommatid.scenes.hardware.photon_transfer import background, photon_transfer, rounding
from ommatid.scenes.model import RECORDED, Model
from ommatid.scenes.scene import read
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..conftest import Command
from ..examples import camera as paper_camera
from ..examples import familywise

Array = NDArray[Any]

SCENE = """
[target]
image = "photo:camera"
shape = [12, 14]
pixel_pitch = "1 mm"
distance = "1 m"

[camera]
pixel_pitch = "6 um"
lens_pitch = "0.064 mm"

[[camera.lens]]
name = "I"
magnification = "1/2"
array = [2, 2]
pixels = "fit"

[[camera.lens]]
name = "II"
magnification = "1/3"
array = [3, 3]
pixels = [3, 4]
"""
SHAPE = (42, 62)
NOISE = "\n[noise]\nvariance = 0.25\n"


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Camera:
    """The camera of scene.toml in the current folder."""
    (tmp_path / "scene.toml").write_text(SCENE + NOISE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return derive(read(Path("scene.toml")))


def on_the_sensor(camera: Camera, values: Array, shape: tuple[int, int] = SHAPE, nothing: float = 0.0) -> Array:
    """A mosaic, point by point: a pixel of an upright sub-image looks along (-x, -y), so it stands on the other side.

    The mosaic is seen from behind the camera: right is -x, down is -y, and its middle is x = y = 0.
    """
    mosaic = np.full(shape, nothing)
    pitch = camera.pixel_pitch
    for sub, place in zip(camera.sub_imagers, camera.slices(), strict=True):
        rows, columns = sub.type.pixels
        for row in range(rows):
            for column in range(columns):
                x = sub.patch[0] + (column + 0.5 - columns / 2) * pitch
                y = sub.patch[1] + (row + 0.5 - rows / 2) * pitch
                where = floor(shape[0] / 2 - y / pitch), floor(shape[1] / 2 - x / pitch)
                mosaic[where] = values[place].reshape(rows, columns)[row, column]
    return mosaic


def save(path: Path, pixels: Array) -> Path:
    if path.suffix == ".npy":
        np.save(path, pixels)
    elif path.suffix == ".exr":
        write_truth(path, pixels)
    else:
        save_image: Any = io.imsave  # pyright: ignore[reportUnknownVariableType]
        save_image(path, pixels, check_contrast=False)
    return path


def seen(camera: Camera, seed: int = 1) -> tuple[Array, Array]:
    """An image drawn from the prior, and what the ideal camera reads of it, with noise of variance 0.25."""
    rng = np.random.default_rng(seed)
    image = rng.normal(127.5, 5461.25**0.5, camera.unknowns)
    return image, ideal_matrix(camera) @ image + rng.normal(0, 0.5, camera.measurements)


# --- where sub-images lie


def test_the_scene_is_one_whose_patches_lie_beside_whole_pixels(bench: Camera) -> None:
    """Else rounding would hide mistakes of one pixel."""
    away = patches(bench) - np.floor(patches(bench))
    assert away.min() < 0.4 < 0.6 < away.max()


@pytest.mark.parametrize(
    ("name", "kind", "step"),
    [("m.png", np.uint16, 1), ("m.tiff", np.uint16, 1), ("m.npy", np.float64, 0), ("m.exr", np.float32, 0)],
)
def test_a_mosaic_gives_back_the_sub_images(
    bench: Camera, ommatid: Command, name: str, kind: type[Any], step: int
) -> None:
    _, values = seen(bench)
    values = np.rint(values + 1000) if step else values.astype(np.float32).astype(np.float64)
    mosaic = save(Path(name), on_the_sensor(bench, values).astype(kind))
    ended = ommatid("import", "scene.toml", mosaic, "-o", "stack.exr", "--json")
    assert ended.code == 0, ended.err
    cut = stack.read(Path("stack.exr"))
    np.testing.assert_array_equal(cut.values, values.astype(np.float32))
    assert not cut.variance.any()
    described = json.loads(ended.out)
    assert described["method"] == "imported"
    assert [source["name"] for source in described["source"]] == [name]
    assert "beside whole pixels" in ended.err


def test_letters_on_the_sensor_come_out_upright(tmp_path: Path, ommatid: Command) -> None:
    """By hand: four lenses 20 pixels apart see the same middle, so their patches stand a little more than that apart.

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
    (tmp_path / "scene.toml").write_text(scene, encoding="utf-8")
    mosaic = np.zeros((50, 60), dtype=np.uint8)
    expected: list[Array] = []
    for number, (row, column) in enumerate([(15, 20), (15, 40), (35, 20), (35, 40)]):
        told = letter * (number + 1)
        # Patches of 5 x 4 pixels around (15 - 0.03, 20 - 0.03) and so on: rows 12.47 to 17.47, columns 17.97 to 21.97.
        top = {15: 12, 35: 33}[row]
        mosaic[top : top + 5, column - 2 : column + 2] = told[::-1, ::-1]
        expected.append(told)
    picture, out = save(tmp_path / "m.png", mosaic), tmp_path / "s.exr"
    ended = ommatid("import", tmp_path / "scene.toml", picture, "-o", out)
    assert ended.code == 0, ended.err
    images = stack.read(out).images()
    np.testing.assert_array_equal(images, expected)
    ended = ommatid("import", tmp_path / "scene.toml", picture, "-o", out, "--upright")
    assert ended.code == 0, ended.err
    np.testing.assert_array_equal(stack.read(out).images(), np.array(expected)[:, ::-1, ::-1])


def test_the_origin_says_where_the_first_patch_begins(bench: Camera, ommatid: Command) -> None:
    _, values = seen(bench)
    mosaic = on_the_sensor(bench, values)
    nearest = np.floor(patches(bench) + np.array(SHAPE) / 2 + 0.5).astype(int)
    top, left = nearest.min(axis=0).tolist()
    save(Path("cut.npy"), mosaic[top:, left:])
    row, column = (nearest[0] - nearest.min(axis=0)).tolist()
    ended = ommatid("import", "scene.toml", "cut.npy", "-o", "s.exr", "--origin", f"{row},{column}", "--json")
    assert ended.code == 0, ended.err
    places = patches(bench) - patches(bench)[0]
    beside = np.abs(places - np.rint(places)).max()
    assert json.loads(ended.out)["beside_pixels"] == pytest.approx(beside, abs=1e-9)
    first = stack.read(Path("s.exr")).images()[0]
    np.testing.assert_array_equal(first.ravel(), values[bench.slices()[0]].astype(np.float32))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 60), st.integers(0, 60))
def test_moving_the_picture_and_its_origin_changes_nothing(tmp_path_factory: Any, down: int, right: int) -> None:
    folder = tmp_path_factory.mktemp("moved")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    camera = derive(read(folder / "scene.toml"))
    rng = np.random.default_rng(0)
    mosaic = rng.random((200, 220))
    moved = np.pad(mosaic, ((down, 3), (right, 5)))
    found = [
        read_frames(camera, [save(folder / name, pixels)], AcquisitionSettings(origin=origin), mosaics=False).numbers
        for name, pixels, origin in (
            ("a.npy", mosaic, (40, 10)),
            ("b.npy", moved, (40 + down, 10 + right)),
        )
    ]
    np.testing.assert_array_equal(found[0], found[1])


def test_a_picture_a_sub_imager_comes_in_the_order_of_measurements(bench: Camera, ommatid: Command) -> None:
    _, values = seen(bench)
    pairs = zip(bench.sub_imagers, bench.slices(), strict=True)
    upright = [values[place].reshape(sub.type.pixels) for sub, place in pairs]
    names = [save(Path(f"p{number:02d}.npy"), picture) for number, picture in enumerate(upright)]
    Path("turned").mkdir()
    for number, picture in enumerate(upright):
        save(Path(f"turned/{number:02d}.npy"), picture[::-1, ::-1])
    for pictures in (names, ["turned", "--turned"]):
        ended = ommatid("import", "scene.toml", *pictures, "-o", "s.exr")
        assert (ended.code, "beside" in ended.err) == (0, False), ended.err
        np.testing.assert_array_equal(stack.read(Path("s.exr")).values, values.astype(np.float32))


# --- what the numbers mean


def test_dark_and_flat_frames_take_out_what_pixels_have_of_their_own(bench: Camera, ommatid: Command) -> None:
    rng = np.random.default_rng(2)
    _, values = seen(bench)
    gain, offset = rng.uniform(5, 9, values.size), rng.uniform(100, 200, values.size)
    spread = rng.normal(0, 3, (2, values.size))
    spread -= spread.mean(axis=0)  # two frames whose mean is right
    for number in (0, 1):
        save(Path(f"dark{number}.npy"), on_the_sensor(bench, offset + spread[number]))
        save(Path(f"flat{number}.npy"), on_the_sensor(bench, offset + 200 * gain + spread[number]))
    save(Path("image.npy"), on_the_sensor(bench, offset + gain * values))
    files = ["--dark", "dark0.npy", "--dark", "dark1.npy", "--flat", "flat0.npy", "--flat", "flat1.npy"]
    ended = ommatid("import", "scene.toml", "image.npy", "-o", "s.exr", *files, "--flat-value", "200")
    assert ended.code == 0, ended.err
    np.testing.assert_allclose(stack.read(Path("s.exr")).values, values, rtol=1e-5, atol=1e-3)
    ended = ommatid("import", "scene.toml", "image.npy", "-o", "s.exr", "--dark", "dark0.npy")
    np.testing.assert_allclose(stack.read(Path("s.exr")).values, gain * values - spread[0], rtol=1e-5, atol=1e-3)


def test_pixels_whose_flat_is_not_above_the_dark_are_dead(bench: Camera, ommatid: Command) -> None:
    _, values = seen(bench)
    dark, flat = np.full(values.size, 10.0), np.full(values.size, 265.0)
    flat[3], flat[70], dark[90] = 10.0, np.nan, 300.0
    for name, numbers in (("image", 10 + values), ("dark", dark), ("flat", flat)):
        save(Path(f"{name}.npy"), on_the_sensor(bench, numbers))
    ended = ommatid("import", "scene.toml", "image.npy", "-o", "s.exr", "--dark", "dark.npy", "--flat", "flat.npy")
    assert ended.code == 0, ended.err
    assert "3 sensor pixels are dead" in ended.err
    assert set(np.flatnonzero(np.isnan(stack.read(Path("s.exr")).values))) == {3, 70, 90}


SENSOR = """
[sensor]
illuminance = "500 lux"
exposure = "10 ms"
frames = 50
"""


def test_with_a_sensor_the_stack_holds_digital_numbers(bench: Camera, ommatid: Command) -> None:
    lensed = SCENE.replace("pixels =", 'aperture = "0.1 mm"\npixels =')
    Path("scene.toml").write_text(lensed + SENSOR, encoding="utf-8")
    _, values = seen(bench)
    digital = np.clip(np.rint(100 + 7 * values), 0, 4094)
    for name, numbers in (("image", digital), ("dark", 100), ("flat", 100 + 7 * 255)):
        pixels = on_the_sensor(bench, np.broadcast_to(np.float64(numbers), values.shape), nothing=100)
        save(Path(f"{name}.png"), pixels.astype(np.uint16))
    frames = ["--dark", "dark.png", "--flat", "flat.png"]
    ended = ommatid("import", "scene.toml", "image.png", "-o", "s.exr", *frames)
    assert ended.code == 0, ended.err
    made = stack.read(Path("s.exr"))
    assert made.recording is not None
    np.testing.assert_array_equal(made.recording.digital, digital)
    np.testing.assert_allclose(made.values, (digital - 100) / 7)
    assert made.recording.sensor.frames == 50
    ended = ommatid("import", "scene.toml", "image.png", "-o", "s.exr", *frames, *frames)
    made = stack.read(Path("s.exr"))
    assert made.recording is not None
    assert made.recording.sensor.frames == 2
    ended = ommatid("import", "scene.toml", "image.png", "-o", "s.exr")
    assert ended.code == 2
    assert "--dark" in ended.err


def test_an_imported_stack_is_reconstructed_with_the_error_that_is_expected(bench: Camera, ommatid: Command) -> None:
    image, values = seen(bench)
    save(Path("m.npy"), on_the_sensor(bench, values))
    assert ommatid("import", "scene.toml", "m.npy", "-o", "s.exr").code == 0
    scene = read(Path("scene.toml"))
    made = ideal_model(scene, bench)
    record = {"method": "ideal", "versions": {}, "seconds": 0.0}
    model_file.write(Path("h.npz"), Model(scene, bench, made.stored, made.variance, made.batches, record))
    ended = ommatid("reconstruct", "s.exr", "h.npz", "-o", "e.exr", "--json")
    assert ended.code == 0, ended.err
    described = json.loads(ended.out)
    assert described["seeds"] == {"scene": None, "data": None, "calibration": None}
    assert described["stages"]["render"]["method"] == "imported"
    assert_error_as_expected(image, Path("e.exr"), described["error"]["predicted_mse"])
    ended = ommatid("reconstruct", "s.exr", "h.npz", "-o", "e.exr")
    assert "import, seconds" in ended.out


def assert_error_as_expected(image: Array, estimated: Path, predicted: float) -> None:
    """Of independent errors the mean square is a mean of as many chi-squared ones; theirs are not, so twice as wide."""
    channels = exr.read(estimated)[0].channels
    away = channels["estimate"].ravel() - image
    variance = channels["variance"].ravel().astype(np.float64)
    deviation = 2 * np.sqrt(2 * np.sum(variance**2)) / variance.size
    assert variance.mean() == pytest.approx(predicted, rel=1e-5)
    assert abs(np.mean(away**2) - predicted) < 3 * deviation
    assert predicted < 5461.25 / 2


# --- H from recorded points

GAIN, READ = 0.02, 0.3  # units of f for an electron, and its standard deviation without light


def lit(matrix: sparse.csr_array, sources: Array, rng: np.random.Generator) -> Array:
    """What the sensor reads of a sparse image of sources, with the noise of photons and of reading: values of f."""
    light = matrix @ sources
    return rng.poisson(light / GAIN) * GAIN + rng.normal(0, READ, light.size)


def sweep(camera: Camera, matrix: sparse.csr_array, times: int, rng: np.random.Generator) -> Array:
    points = [
        on_the_sensor(camera, lit(matrix, 255.0 * one, rng)) for _ in range(times) for one in np.eye(camera.unknowns)
    ]
    return np.array(points, dtype=np.float32)


def blurred(camera: Camera) -> sparse.csr_array:
    """An H that is not the ideal one: seen through a little blur of the target, which stays within the margin."""
    sizes = camera.rows, camera.columns
    kernel = [sparse.diags_array([0.2, 0.6, 0.2], offsets=[-1, 0, 1], shape=(size, size)) for size in sizes]
    return sparse.csr_array(ideal_matrix(camera) @ sparse.kron(*kernel, format="csr"))


def assert_is(found: Model, truth: sparse.csr_array, known: Array | slice = slice(None)) -> None:
    """Every entry is right within its stated variance, which is none too large, and those left out are 0."""
    rows = np.repeat(np.arange(found.measurements), np.diff(found.matrix.indptr))
    left_out = truth.toarray()
    left_out[rows, found.matrix.indices] = 0.0
    assert not left_out.any()
    expected = np.asarray(truth[rows, found.matrix.indices]).ravel()
    z = (found.matrix.data - expected) / np.sqrt(found.variance)
    z = z[known]
    # Few photons are not normal: the tails of a Poisson variable reach further than its variance says.
    assert np.abs(z).max() < 1.3 * stats.norm.isf(familywise(z.size) / 2)
    assert np.mean(z**2) == pytest.approx(1, abs=5 * (3 / z.size) ** 0.5)


@pytest.mark.parametrize("times", [1, 2, 5])
def test_swept_points_give_back_h_within_its_stated_variance(bench: Camera, ommatid: Command, times: int) -> None:
    """Once, only the background tells of noise, and that of photons is not in it: then there is none."""
    rng = np.random.default_rng(times)
    truth = blurred(bench)
    if times == 1:
        light = [truth @ (255 * one) for one in np.eye(bench.unknowns)]
        frames = np.array([on_the_sensor(bench, one + rng.normal(0, READ, one.size)) for one in light])
    else:
        frames = sweep(bench, truth, times, rng)
    np.save("points.npy", frames)
    ended = ommatid("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz", "--json")
    assert ended.code == 0, ended.err
    found = model_file.read(Path("h.npz"))
    assert_is(found, truth)
    assert ("recorded once" in ended.err) == (times == 1)
    described = json.loads(ended.out)
    assert (described["method"], described["exposures"]) == ("recorded points", times * bench.unknowns)


def test_the_image_is_reconstructed_with_the_h_that_was_recorded(bench: Camera, ommatid: Command) -> None:
    rng = np.random.default_rng(7)
    truth = blurred(bench)
    image = rng.normal(127.5, 5461.25**0.5, bench.unknowns)
    save(Path("m.npy"), on_the_sensor(bench, truth @ image + rng.normal(0, 0.5, bench.measurements)))
    np.save("points.npy", sweep(bench, truth, 3, rng))
    assert ommatid("import", "scene.toml", "m.npy", "-o", "s.exr").code == 0
    assert ommatid("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz").code == 0
    ended = ommatid("reconstruct", "s.exr", "h.npz", "-o", "e.exr", "--json")
    assert ended.code == 0, ended.err
    described = json.loads(ended.out)
    assert described["stages"]["calibrate"]["method"] == "recorded points"
    assert described["error"]["budget"]["calibration"] > 0
    assert_error_as_expected(image, Path("e.exr"), described["error"]["predicted_mse"])


def test_what_the_errors_of_h_add_is_what_they_scatter(bench: Camera, tmp_path: Path) -> None:
    """Calibrated again and again, H f scatters as `spread` says."""
    rng = np.random.default_rng(8)
    truth, image = ideal_matrix(bench), rng.uniform(0, 255, bench.unknowns)
    entries = truth.copy()
    deviation: NDArray[np.float64] = np.linspace(0.01, 0.03, entries.nnz)
    away: list[Array] = []
    for _ in range(200):
        entries.data = truth.data + rng.normal(0, deviation)
        away.append((entries @ image - truth @ image) ** 2)
    none = np.zeros((0, truth.nnz), dtype=np.float32)
    scene = read(tmp_path / "scene.toml")
    recorded = Model(scene, bench, truth, deviation**2, none, {"method": RECORDED})
    ratio = np.mean(away, axis=0) / recorded.variance_from_model(image)
    assert ratio.mean() == pytest.approx(1, abs=5 * (2 / 200 / ratio.size) ** 0.5)


def grids(camera: Camera, apart: int) -> list[Array]:
    """Rows and columns of sources that shine together."""
    return [
        np.array([(i, j) for i in range(row, camera.rows, apart) for j in range(column, camera.columns, apart)])
        for row in range(apart)
        for column in range(apart)
    ]


def write_places(path: str, places: list[Array], names: list[str]) -> None:
    lines = [f"{name},{row},{column}" for name, some in zip(names, places, strict=True) for row, column in some]
    Path(path).write_text("\n".join(["image,row,column", *lines, ""]), encoding="utf-8")


def record_grids(camera: Camera, matrix: sparse.csr_array, places: list[Array], name: str, seed: int) -> list[str]:
    rng = np.random.default_rng(seed)
    names: list[str] = []
    for number, some in enumerate(places):
        sources = np.zeros(camera.shape)
        sources[some[:, 0], some[:, 1]] = 255.0
        light = lit(matrix, sources.ravel(), rng)
        names.append(save(Path(f"{name}{number:02d}.exr"), on_the_sensor(camera, light)).name)
    return names


def test_several_points_may_shine_at_once(bench: Camera, ommatid: Command) -> None:
    truth, places = blurred(bench), grids(bench, 6)
    names = record_grids(bench, truth, places, "a", 5) + record_grids(bench, truth, places, "b", 6)
    write_places("p.csv", [*places, *places], names)
    ended = ommatid("calibrate", "scene.toml", "--points", *names, "--places", "p.csv", "-o", "h.npz")
    assert ended.code == 0, ended.err
    assert_is(model_file.read(Path("h.npz")), truth)


def with_ghost(camera: Camera) -> sparse.csr_array:
    """The first sensor pixel sees the target's last pixel, far away, too."""
    last = sparse.csr_array(([0.05], ([0], [camera.unknowns - 1])), shape=(camera.measurements, camera.unknowns))
    return sparse.csr_array(ideal_matrix(camera) + last)


def test_light_far_from_the_footprint_is_found_where_one_point_shines_alone(bench: Camera, ommatid: Command) -> None:
    truth = with_ghost(bench)
    np.save("points.npy", sweep(bench, truth, 2, np.random.default_rng(3)))
    assert ommatid("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz").code == 0
    assert_is(model_file.read(Path("h.npz")), truth)


def test_light_far_from_all_footprints_is_warned_of_where_several_shine(bench: Camera, ommatid: Command) -> None:
    places = [np.array([(row, column), (row, column + 7)]) for row in range(12) for column in range(7)]
    names = record_grids(bench, with_ghost(bench), places, "a", 5)
    write_places("p.csv", places, names)
    ended = ommatid("calibrate", "scene.toml", "--points", *names, "--places", "p.csv", "-o", "h.npz")
    assert ended.code == 0, ended.err
    assert "1 readings beyond the footprints" in ended.err


def test_a_dead_pixel_tells_nothing_of_h(bench: Camera, ommatid: Command) -> None:
    frames = sweep(bench, ideal_matrix(bench), 2, np.random.default_rng(4))
    values = np.zeros(bench.measurements)
    values[17] = np.nan
    np.save("points.npy", frames + on_the_sensor(bench, values).astype(np.float32))
    assert ommatid("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz").code == 0
    found = model_file.read(Path("h.npz"))
    dead = slice(*found.matrix.indptr[17:19])
    assert not found.matrix.data[dead].any()
    assert (found.variance[dead] == 1).all()


def test_dark_flat_and_rounding_are_known_to_calibration(bench: Camera, ommatid: Command) -> None:
    """Whole numbers of coarse steps without other noise: all errors are rounding, of 1/12 of a step squared."""
    truth = ideal_matrix(bench)
    rng = np.random.default_rng(6)
    gain, offset = rng.uniform(0.3, 0.5, bench.measurements), rng.integers(10, 20, bench.measurements)
    light = (on_the_sensor(bench, offset + gain * (truth @ (255.0 * one))) for one in np.eye(bench.unknowns))
    np.save("points.npy", np.array([np.rint(one) for one in light]).astype(np.uint8))
    frames = [save(Path("dark.npy"), on_the_sensor(bench, offset))]
    frames.append(save(Path("flat.npy"), on_the_sensor(bench, offset + 255 * gain)))
    ended = ommatid(
        *("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz", "--dark", frames[0], "--flat", frames[1])
    )
    assert ended.code == 0, ended.err
    found = model_file.read(Path("h.npz"))
    rows = np.repeat(np.arange(found.measurements), np.diff(found.matrix.indptr))
    np.testing.assert_allclose(found.variance, (1 / (255 * gain[rows])) ** 2 / 12, rtol=1e-6)
    away = np.asarray(truth[rows, found.matrix.indices]).ravel() - found.matrix.data
    assert np.abs(away * 255 * gain[rows]).max() <= 0.5 + 1e-9


def test_a_sensor_tells_of_photons_where_points_were_recorded_once(bench: Camera, ommatid: Command) -> None:
    """Full pixels tell nothing: one frame is brighter than the sensor can say."""
    told = SCENE.replace("pixels =", 'aperture = "0.1 mm"\npixels =') + SENSOR + "gain = 0.1\n"
    Path("scene.toml").write_text(told, encoding="utf-8")
    truth, rng = ideal_matrix(bench), np.random.default_rng(9)
    frames: list[Array] = []
    for one in np.eye(bench.unknowns):
        light = truth @ (2550 * one)  # electrons, of which a digital number has 10
        digital = rng.poisson(light) * 0.1 + rng.normal(10, 0.7, light.size)
        frames.append(on_the_sensor(bench, np.rint(np.maximum(digital, 0)), nothing=10))
    full = bench.unknowns // 2
    frames[full] = np.where(frames[full] > 30, 4095, frames[full])
    np.save("points.npy", np.array(frames).astype(np.uint16))
    save(Path("dark.npy"), np.full(SHAPE, 10.0))
    save(Path("flat.npy"), np.full(SHAPE, 265.0))
    ended = ommatid(
        *("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz", "--dark", "dark.npy"),
        *("--flat", "flat.npy"),
    )
    assert (ended.code, "recorded once" in ended.err) == (0, False), ended.err
    found = model_file.read(Path("h.npz"))
    assert_is(found, truth, found.variance < 1)
    assert set(found.matrix.indices[found.variance == 1]) == {full}


# --- what is refused, in one sentence

PLACES = {
    "header": "row,column\n1,2",
    "outside": "image,row,column\n0,12,0",
    "negative": "image,row,column\n0,-1,0",
    "word": "image,row,column\n0,one,0",
    "stranger": "image,row,column\nother.png,0,0",
    "short": "image,row,column\n0,1",
    "twice": "image,row,column\nm.npy,0,0\n0,0,0",
    "close": "image,row,column\nm.npy,5,5\n0,6,6",
    "few": "image,row,column\n0,0,0",
    "none": "image,row,column",
}


def spoil() -> None:
    """Files for the commands below; some are wrong, which is what they are there for."""
    save(Path("m.npy"), np.zeros(SHAPE))
    save(Path("small.npy"), np.zeros((20, 30)))
    save(Path("dark.npy"), np.zeros((42, 61)))
    save(Path("three.npy"), np.zeros((3, *SHAPE)))
    save(Path("complex.npy"), np.zeros(SHAPE, dtype=complex))
    Path("note.npy").write_text("This is a note.\n", encoding="utf-8")
    Path("photo.jpg").write_bytes(b"no")
    Path("empty").mkdir()
    for name, text in PLACES.items():
        Path(f"{name}.csv").write_text(text + "\n", encoding="utf-8")


IMPORT, CALIBRATE = ("import", "scene.toml", "-o", "new"), ("calibrate", "scene.toml", "-o", "new", "--points")
SMALL = ["small.npy"] * 13


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((*IMPORT, "small.npy"), ("small.npy", "I.00.00", "20 x 30", "--origin")),
        ((*IMPORT, "m.npy", "--origin", "30,30"), ("leaves the mosaic", "42 x 62")),
        ((*IMPORT, "m.npy", "--origin", "3"), ("--origin", "ROW,COLUMN")),
        ((*IMPORT, "m.npy", "--origin", "-3,1"), ("leaves the mosaic",)),
        ((*IMPORT, "m.npy", "small.npy"), ("13 pictures", "got 2")),
        ((*IMPORT, "three.npy"), ("13 pictures", "got 3")),
        ((*IMPORT, *SMALL), ("small.npy", "5 x 6", "20 x 30")),
        ((*IMPORT, *SMALL, "--origin", "1,1"), ("--origin", "mosaic")),
        ((*IMPORT, "gone.png"), ("gone.png", "no such file")),
        ((*IMPORT, "note.npy"), ("note.npy", "could not be read")),
        ((*IMPORT, "photo.jpg"), ("photo.jpg", "PNG, TIFF, EXR or NPY")),
        ((*IMPORT, "complex.npy"), ("complex.npy", "complex128")),
        ((*IMPORT, "empty"), ("empty", "none of them")),
        ((*IMPORT, "m.npy", "--dark", "dark.npy"), ("dark.npy", "42 x 62", "42 x 61")),
        ((*IMPORT, "m.npy", "--flat", "dark.npy"), ("dark.npy", "42 x 62", "42 x 61")),
        ((*IMPORT, "m.npy", "--flat-value", "0"), ("--flat-value", "above 0")),
        (("import", "scene.toml", "m.npy", "-o", "m.npy"), ("m.npy", "would replace")),
        (("import", "scene.toml", "m.npy", "-o", "dark.npy", "--dark", "dark.npy"), ("would replace",)),
        (("import", "scene.toml", "m.npy", "-o", "no/new"), ("does not exist",)),
        ((*CALIBRATE, "m.npy"), ("168 pixels", "got 1", "--places")),
        ((*CALIBRATE, "m.npy", "--places", "header.csv"), ("header.csv", "image,row,column")),
        ((*CALIBRATE, "m.npy", "--places", "gone.csv"), ("gone.csv", "could not be read")),
        ((*CALIBRATE, "m.npy", "--places", "outside.csv"), ("line 2", "row 12", "12 x 14")),
        ((*CALIBRATE, "m.npy", "--places", "negative.csv"), ("line 2", "row -1")),
        ((*CALIBRATE, "m.npy", "--places", "word.csv"), ("line 2", "'one'")),
        ((*CALIBRATE, "m.npy", "--places", "stranger.csv"), ("line 2", "other.png")),
        ((*CALIBRATE, "m.npy", "--places", "short.csv"), ("line 2", "fewer")),
        ((*CALIBRATE, "m.npy", "--places", "twice.csv"), ("line 3", "twice")),
        ((*CALIBRATE, "m.npy", "--places", "close.csv"), ("m.npy", "(5, 5)", "(6, 6)", "two images")),
        ((*CALIBRATE, "m.npy", "--places", "few.csv"), ("few.csv", "row 0, column 1")),
        ((*CALIBRATE, "m.npy", "--places", "none.csv"), ("none.csv", "m.npy")),
        ((*CALIBRATE, "m.npy", "--point-value", "-1"), ("--point-value",)),
        (("calibrate", "scene.toml", "-o", "new", "--places", "few.csv"), ("--points",)),
    ],
)
@pytest.mark.usefixtures("bench")
def test_what_is_wrong_is_said_in_one_sentence(
    ommatid: Command, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    spoil()
    before = {path: path.stat().st_mtime_ns for path in Path().iterdir()}
    ended = ommatid(*arguments)
    assert ended.code == 2, ended.err
    assert len(ended.err.splitlines()) == 1, ended.err
    for word in words:
        assert word in ended.err, ended.err
    assert {path: path.stat().st_mtime_ns for path in Path().iterdir()} == before


# --- noise


def test_photon_transfer_finds_the_noise_of_the_dark_and_of_photons() -> None:
    """Readings of Poisson counts and normal noise; the fit's own error is that of the weighted least squares."""
    rng = np.random.default_rng(0)
    light = np.repeat([0.0, 1.0, 5.0, 40.0], 500)
    readings = rng.poisson(light / GAIN, (6, light.size)) * GAIN + rng.normal(0, READ, (6, light.size))
    mean, variance = readings.mean(axis=0), readings.var(axis=0, ddof=1)
    dark, photons = photon_transfer(mean, variance, np.full(light.size, 6))
    assert dark == pytest.approx(READ**2, rel=5 * (2 / 5 / 500) ** 0.5)
    assert photons == pytest.approx(GAIN, rel=5 * (2 / 5 / 1000) ** 0.5)


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.2, 0.4])
def test_rounding_leaves_in_a_mean_at_most_what_is_said(deviation: float) -> None:
    """The mean of rounded normal readings, by summing over all that they may become, for places between two steps."""
    steps = np.arange(-8, 9)
    places = np.linspace(-0.5, 0.5, 201)[:, None]
    if deviation == 0:
        mean = np.rint(places[:, 0])
    else:
        above, below = (stats.norm.cdf((steps + half - places) / deviation) for half in (0.5, -0.5))
        mean = (above - below) @ steps
    left = np.trapezoid((mean - places[:, 0]) ** 2, places[:, 0])
    said = float(rounding(np.array([deviation**2]), np.ones(1))[0])
    assert left == pytest.approx(said, rel=0.01) if deviation == 0 else 0.5 * said < left <= said


def test_light_is_told_from_the_background_as_often_as_is_said() -> None:
    rng = np.random.default_rng(1)
    taken = [(noise > background(noise, 0.05)[1]).any() for noise in rng.normal(0, 1, (200, 10000))]
    assert stats.binomtest(int(np.sum(taken)), 200, 0.05).pvalue > 0.001
    assert background(np.append(rng.normal(0, 1, 200), 30.0), 0.01)[0] == pytest.approx(1, abs=0.5)


def test_lens_types_that_are_left_out_stand_on_the_sensor_nevertheless(bench: Camera, ommatid: Command) -> None:
    _, values = seen(bench)
    save(Path("m.npy"), on_the_sensor(bench, values))
    assert ommatid("import", "scene.toml", "m.npy", "-o", "s.exr", "--lens", "II").code == 0
    expected = values[bench.type_slices()[1]].astype(np.float32)
    np.testing.assert_array_equal(stack.read(Path("s.exr")).values, expected)


@pytest.mark.parametrize("pages", [2, 3, 4, 5])
@pytest.mark.parametrize("contiguous", [True, False])
def test_every_page_of_a_tiff_is_a_picture(pages: int, contiguous: bool, tmp_path: Path) -> None:
    """Three or four are no colours, and pages that are series of their own are pages too."""
    import tifffile

    frames = np.arange(pages * 600, dtype=np.uint16).reshape(pages, 20, 30)
    with cast(Any, tifffile).TiffWriter(tmp_path / "dark.tif") as file:
        for frame in frames:
            file.write(frame, contiguous=contiguous, photometric="minisblack")
    found = pictures_of(tmp_path / "dark.tif", "dark frames")
    assert len(found) == pages
    np.testing.assert_array_equal(np.array(found), frames)


def test_a_colour_array_is_one_picture(tmp_path: Path) -> None:
    np.save(tmp_path / "colour.npy", np.zeros((20, 30, 3), dtype=np.uint8))
    assert [one.shape for one in pictures_of(tmp_path / "colour.npy", "images")] == [(20, 30, 3)]


def test_points_that_shine_together_are_not_told_apart_by_footprints_that_are_not_theirs() -> None:
    camera = paper_camera()
    several = [np.array([[0, 0], [9, 9]])]
    point_sources._check_separable(camera, several, Path("places.csv"))  # pyright: ignore[reportPrivateUsage]
    glass = replace(camera.types[0].optics, distortion=(0.1, 0.0))
    bent = replace(camera, types=(replace(camera.types[0], optics=glass),))
    with pytest.raises(InputError, match="record one point an image"):
        point_sources._check_separable(bent, several, Path("places.csv"))  # pyright: ignore[reportPrivateUsage]
