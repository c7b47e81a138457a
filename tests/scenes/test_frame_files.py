"""Recorded frames keep the numbers of their files, and what is not kept is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import tifffile

from ommatid.pipeline.camera_files import import_file
from ommatid.runtime.errors import InputError
from ommatid.scenes import stack
from ommatid.scenes.hardware.frames import AcquisitionSettings, FrameNotes, stored_pictures

from . import picture_bytes as made
from .mosaics import SCENE, SHAPE

RNG = np.random.default_rng(19)


def test_every_page_is_a_frame_and_is_turned_by_its_own_orientation(tmp_path: Path) -> None:
    frames = RNG.integers(0, 4096, (3, 12, 17)).astype(np.uint16)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for frame, orientation in zip((frames[0], frames[1][:, ::-1], frames[2].T), (1, 2, 5), strict=True):
            tag = [(274, 3, 1, orientation, True)]
            cast(Any, file).write(np.ascontiguousarray(frame), photometric="minisblack", metadata=None, extratags=tag)
    found = [stored.pixels for stored in stored_pictures(tmp_path / "a.tif", "images")]
    np.testing.assert_array_equal(found, frames)


def test_jpeg_is_refused_by_its_content(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(made.jpeg(np.zeros((16, 16), np.uint8)))
    with pytest.raises(InputError, match=r"a\.png could not be read as a picture \(not a PNG file\)"):
        stored_pictures(tmp_path / "a.png", "images")


def noted(tmp_path: Path, **frames: bytes | np.ndarray[Any, Any]) -> list[str]:
    """What is said of frames of these kinds."""
    notes = FrameNotes()
    for what, content in frames.items():
        path = tmp_path / f"{what}.{'png' if isinstance(content, bytes) else 'npy'}"
        path.write_bytes(content) if isinstance(content, bytes) else np.save(path, content)
        for stored in stored_pictures(path, what):
            notes.add(path, stored, what)
    return notes.describe()


def test_frames_of_different_bits_are_said(tmp_path: Path) -> None:
    zeros = np.zeros((8, 9), np.int64)
    grey4, grey8, grey16 = (made.png(zeros, 0, bits) for bits in (4, 8, 16))
    assert noted(tmp_path, images=grey16, dark=grey16, flat=grey16) == []
    assert noted(tmp_path, images=grey16, dark=np.zeros((8, 9)), flat=np.zeros((8, 9), np.float32)) == []
    (said,) = noted(tmp_path, images=grey16, dark=grey8, flat=grey8)
    assert said.startswith("frames have 16-bit numbers (images) and 8-bit numbers (dark), which are taken as they are")
    (said,) = noted(tmp_path, images=grey8, flat=grey4)
    assert "8-bit numbers (images) and 4-bit numbers (flat)" in said


def test_colour_and_orientation_are_said_once_per_kind_of_frames(tmp_path: Path) -> None:
    colour = made.png(RNG.integers(0, 255, (8, 9, 3)), 2, 8, made.chunk(b"eXIf", made.exif(3)))
    said = noted(tmp_path, images=colour, dark=colour)
    assert [Path(sentence.split()[0]).name for sentence in said] == ["images.png"] * 2 + ["dark.png"] * 2
    assert "only its luminance is used" in said[0]
    assert "orientation 3 of EXIF" in said[1]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, np.longdouble("1e4000")])
@pytest.mark.parametrize("kind", ["image", "dark"])
def test_numbers_that_are_none_are_dead_and_are_said(kind: str, value: float, tmp_path: Path) -> None:
    scene = tmp_path / "s.toml"
    scene.write_text(SCENE, encoding="utf-8")
    for name, level in {"image": 100, "dark": 50, "flat": 200}.items():
        frame = np.full(SHAPE, level, np.longdouble)
        if name == kind:
            frame[18:24, 27:33] = value
        np.save(tmp_path / f"{name}.npy", frame)
    settings = AcquisitionSettings(dark=(tmp_path / "dark.npy",), flat=(tmp_path / "flat.npy",))
    _, warnings = import_file(scene, [tmp_path / "image.npy"], tmp_path / "stack.exr", settings, (), ())
    numbers = np.concatenate([np.ravel(image) for image in stack.read(tmp_path / "stack.exr").images()])
    dead = int(np.sum(~np.isfinite(numbers)))
    assert dead
    np.testing.assert_allclose(numbers[np.isfinite(numbers)], 255 * 50 / 150, rtol=1e-6)
    assert f"{dead} sensor pixels have NaN, infinite or too large numbers" in "\n".join(warnings)
