"""Pictures of all formats become values from 0 to 255."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from skimage import data, io

from ommatid.runtime.errors import InputError
from ommatid.scenes.formats.picture import LUMINANCE, conversions, load, luminance, write_truth
from ommatid.scenes.scene import Scene, with_changes

from ..examples import scene


def looking_at(path: Path, **target: object) -> Scene:
    plain = scene().plain()
    plain["target"] = {"image": path.name, "pixel_pitch": "1 mm", "distance": "1 m", **target}
    return with_changes(plain, path.with_name("scene.toml"), (), ())


def save(path: Path, pixels: NDArray[Any]) -> Path:
    if path.suffix == ".npy":
        np.save(path, pixels)
    elif path.suffix == ".exr":
        write_truth(path, pixels)
    else:
        save_image: Any = io.imsave  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        save_image(path, pixels, check_contrast=False)
    return path


GREY = np.arange(20 * 30, dtype=np.uint8).reshape(20, 30)


@pytest.mark.parametrize(
    ("name", "pixels", "expected"),
    [
        ("grey.png", GREY, GREY),
        ("deep.png", GREY.astype(np.uint16) * 257, GREY),
        ("float.tiff", GREY.astype(np.float32) / 7, GREY / np.float32(7)),
        ("signed.npy", GREY - 300.25, GREY - 300.25),
        ("grey.exr", GREY * 0.5, GREY * 0.5),
        ("bool.npy", GREY > 100, (GREY > 100) * 255.0),
    ],
)
def test_every_format_gives_the_same_values(
    tmp_path: Path, name: str, pixels: NDArray[Any], expected: NDArray[Any]
) -> None:
    image = load(looking_at(save(tmp_path / name, pixels)))
    assert image.dtype == np.float64
    np.testing.assert_array_equal(image, expected)


def test_colour_becomes_luminance() -> None:
    assert sum(LUMINANCE) == pytest.approx(1, abs=1e-12)
    colour: Any = data.astronaut()
    from skimage.color import rgb2gray

    reference: NDArray[np.float64] = np.asarray(rgb2gray(colour)) * 255  # pyright: ignore
    np.testing.assert_allclose(luminance(colour, "here"), reference, atol=1e-10)
    opaque = np.dstack([colour, np.full(colour.shape[:2], 255, np.uint8)])
    np.testing.assert_allclose(luminance(opaque, "here"), reference, atol=1e-10)
    opaque[0, 0, 3] = 7
    with pytest.raises(InputError, match="transparent"):
        luminance(opaque, "here")
    for alpha in (0, 128):  # evenly transparent
        with pytest.raises(InputError, match="transparent"):
            luminance(np.dstack([colour, np.full(colour.shape[:2], alpha, np.uint8)]), "here")


def test_crops_follow_origin_and_shape(tmp_path: Path) -> None:
    path = save(tmp_path / "grey.png", GREY)
    np.testing.assert_array_equal(load(looking_at(path, origin=[3, 5], shape=[10, 12])), GREY[3:13, 5:17])
    np.testing.assert_array_equal(load(looking_at(path, origin=[3, 5])), GREY[3:, 5:])


@pytest.mark.parametrize("target", [{"origin": [15, 0], "shape": [10, 10]}, {"origin": [20, 0]}, {"shape": [19, 30]}])
def test_crops_outside_the_picture_are_refused(tmp_path: Path, target: dict[str, object]) -> None:
    path = save(tmp_path / "grey.png", GREY)
    with pytest.raises(InputError, match=r"20 x 30"):
        load(looking_at(path, **target))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e39])
def test_nan_is_refused_only_inside_the_crop(tmp_path: Path, bad: float) -> None:
    pixels = GREY.astype(np.float64)
    pixels[0, 0] = bad
    path = save(tmp_path / "a.npy", pixels)
    with pytest.raises(InputError, match="NaN"):
        load(looking_at(path))
    load(looking_at(path, origin=[1, 1]))


@pytest.mark.parametrize("bad", [3e38, -3e38, 1.1e12])
def test_values_whose_squares_files_cannot_hold_are_refused(tmp_path: Path, bad: float) -> None:
    pixels = np.ones((20, 30), dtype=np.float32)
    pixels[3, 4] = bad
    described = looking_at(save(tmp_path / "vast.npy", pixels))
    for read in (load, conversions):
        with pytest.raises(InputError, match=r"expected values up to 1e\+12 in .*vast.npy, got one of size"):
            read(described)
    assert load(looking_at(tmp_path / "vast.npy", origin=[4, 0])).max() == 1.0


@pytest.mark.parametrize(
    ("name", "mode", "words"),
    [
        ("a.tif", "P", "the kind PALETTE"),
        ("a.tif", "CMYK", "the kind SEPARATED"),
        ("a.jpg", "CMYK", r"inks \(CMYK\)"),
        ("white.tif", "L", "the kind MINISWHITE"),
    ],
)
def test_values_that_are_not_light_are_refused(name: str, mode: str, words: str, tmp_path: Path) -> None:
    from PIL import Image

    colour = Image.fromarray(np.dstack([GREY, GREY[::-1], GREY[:, ::-1]]))
    options: dict[str, Any] = (
        {"tiffinfo": {262: 0}} if name == "white.tif" else {}
    )  # photometric interpretation: 0 is white
    colour.convert(mode).save(tmp_path / name, **options)
    with pytest.raises(InputError, match=f"{name}: expected grey or RGB, got .*{words}"):
        load(looking_at(tmp_path / name))
