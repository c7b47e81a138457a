"""Stacks on disk: write then read is the identity, and damage is noticed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenes import exr, stack
from scenes.errors import InputError
from scenes.stack import Stack

from .examples import THREE, camera, scene


def example(seed: int = 0) -> Stack:
    rng = np.random.default_rng(seed)
    one = camera()
    values = rng.normal(100, 50, one.measurements).astype(np.float32).astype(np.float64)
    variance = rng.uniform(1e-9, 1, one.measurements).astype(np.float32).astype(np.float64)
    return Stack(scene(lenses=THREE), one, values, variance, {"seed": seed, "note": 'ü "quoted"'})


def test_write_then_read_is_the_identity(tmp_path: Path) -> None:
    first = example()
    stack.write(tmp_path / "stack.exr", first)
    again = stack.read(tmp_path / "stack.exr")
    np.testing.assert_array_equal(again.values, first.values)
    np.testing.assert_array_equal(again.variance, first.variance)
    assert again.record == first.record
    assert again.camera == first.camera
    assert again.scene.plain() == first.scene.plain()
    assert [path.name for path in tmp_path.iterdir()] == ["stack.exr"], "nothing else is left behind"


def test_the_file_is_what_the_contract_says(tmp_path: Path) -> None:
    """Read by OpenEXR itself: a part a sub-imager, its name, its channels, upright float32."""
    import json

    import OpenEXR

    first = example()
    stack.write(tmp_path / "stack.exr", first)
    file = OpenEXR.File(str(tmp_path / "stack.exr"), separate_channels=True)
    names = [part.name() for part in file.parts]
    assert names[:2] == ["A.00.00", "A.00.01"]
    assert len(names) == 50
    part = file.parts[1]
    assert set(part.channels) == {"Y", "variance"}
    assert part.channels["Y"].pixels.dtype == np.float32
    np.testing.assert_array_equal(part.channels["Y"].pixels, first.images()[1])
    assert {"type", "k", "l", "sha256"} <= json.loads(part.header["ommatid"]).keys()


def test_any_flipped_byte_or_missing_end_is_noticed_or_harmless(tmp_path: Path) -> None:
    path = tmp_path / "stack.exr"
    first = example()
    stack.write(path, first)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    noticed = 0
    for place in rng.integers(0, len(whole), 60):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            again = stack.read(path)
        except InputError:
            noticed += 1
        else:
            np.testing.assert_array_equal(again.values, first.values)
            np.testing.assert_array_equal(again.variance, first.variance)
    assert noticed > 30
    for length in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            stack.read(path)


def test_a_part_that_is_missing_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    exr.write(path, [exr.Part("a", {"Y": np.ones((2, 3), np.float32)}, {})])
    with pytest.raises(InputError, match="another kind"):
        stack.read(path)


def test_non_contiguous_pixels_are_stored_as_they_are(tmp_path: Path) -> None:
    pixels = np.arange(24, dtype=np.float32).reshape(4, 6)
    for view in (pixels.T, pixels[::-1], pixels[:, ::2]):
        exr.write(tmp_path / "a.exr", [exr.Part("a", {"Y": view}, {})])
        np.testing.assert_array_equal(exr.read(tmp_path / "a.exr")[0].channels["Y"], view)


def test_restrict_keeps_the_pixels_of_the_named_types() -> None:
    first = example()
    kept = first.restrict(("A", "C"))
    assert kept.camera.measurements == 225 + 256
    np.testing.assert_array_equal(kept.values, np.concatenate([first.values[:225], first.values[450:]]))
    with pytest.raises(InputError, match="'D'"):
        first.restrict(("D",))
