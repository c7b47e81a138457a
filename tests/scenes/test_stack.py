"""Files of stacks: write then read is the identity, and files that do not hold a stack are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes import stack
from ommatid.scenes.camera import derive
from ommatid.scenes.formats import exr
from ommatid.scenes.recording import Recording
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.sensor import SensorTable

from ..examples import THREE, camera, not_none, scene, with_keys


def example(seed: int = 0) -> Stack:
    rng = np.random.default_rng(seed)
    cam = camera()
    values = rng.normal(100, 50, cam.measurements).astype(np.float32).astype(np.float64)
    variance = rng.uniform(1e-9, 1, cam.measurements).astype(np.float32).astype(np.float64)
    return Stack(scene(lenses=THREE), cam, values, variance, {"seed": seed, "note": 'ü "quoted"'})


def sensor_example(seed: int = 0) -> Stack:
    """A recording of a real sensor with cam dead pixel."""
    rng, first = np.random.default_rng(seed), example(seed)
    thin = tuple(lens.model_copy(update={"aperture": 0.1}) for lens in first.scene.camera.lens)
    sensor = SensorTable.model_validate({"illuminance": "500 lux", "exposure": "1 ms", "black_level": 10.0})
    described = with_keys(first.scene, camera={"lens": thin}).model_copy(update={"sensor": sensor})
    cam = derive(described)
    dark = rng.normal(10, 1, cam.measurements).astype(np.float32).astype(np.float64)
    flat = dark + np.repeat([1000.0, 2000.0, 1500.0], [lens_type.measurements for lens_type in cam.types])
    flat[5] = dark[5]
    level = np.repeat([1000 / 7, 1000 / 3, np.pi], [lens_type.measurements for lens_type in cam.types])
    digital = rng.integers(0, 4096, cam.measurements).astype(np.float64)
    flat = flat.astype(np.float32).astype(np.float64)
    recording = Recording(sensor, digital, dark, flat, level)
    return Stack(described, cam, recording.values, first.rendering_variance, first.record, recording)


@pytest.mark.parametrize(("channel", "value"), [("values", 3e38), ("values", np.inf), ("rendering_variance", 1e40)])
def test_readings_beyond_float32_are_not_written(tmp_path: Path, channel: str, value: float) -> None:
    first = example()
    changed = replace(first, **{channel: np.full_like(first.values, value)})
    with pytest.raises(InputError, match=r"expected finite numbers up to 1e\+24 as .*; make the target or its light"):
        stack.write(tmp_path / "stack.exr", changed)
    assert not list(tmp_path.iterdir())


def test_write_then_read_is_the_identity(tmp_path: Path) -> None:
    first = example()
    stack.write(tmp_path / "stack.exr", first)
    again = stack.read(tmp_path / "stack.exr")
    np.testing.assert_array_equal(again.values, first.values)
    np.testing.assert_array_equal(again.rendering_variance, first.rendering_variance)
    assert again.record == first.record
    assert again.camera == first.camera
    assert again.scene.plain() == first.scene.plain()
    assert [path.name for path in tmp_path.iterdir()] == ["stack.exr"], "no other file remains"


def test_the_file_has_the_documented_format(tmp_path: Path) -> None:
    """Read by OpenEXR alone: one part per sub-imager, its name, its channels, upright float32."""
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


def test_non_contiguous_pixels_are_stored_correctly(tmp_path: Path) -> None:
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


def test_a_recording_is_read_as_written(tmp_path: Path) -> None:
    """Values included; writing it again gives the same file."""
    first = sensor_example()
    stack.write(tmp_path / "stack.exr", first)
    again = stack.read(tmp_path / "stack.exr")
    assert first.recording is not None
    assert not_none(again.recording).sensor == first.recording.sensor
    for name in ("digital", "dark", "flat", "flat_value"):
        np.testing.assert_array_equal(getattr(not_none(again.recording), name), getattr(first.recording, name))
    np.testing.assert_array_equal(again.values, first.values)
    assert np.flatnonzero(np.isnan(again.values)).tolist() == [5]
    stack.write(tmp_path / "again.exr", again)
    assert (tmp_path / "again.exr").read_bytes() == (tmp_path / "stack.exr").read_bytes()
    names = set(exr.read(tmp_path / "stack.exr")[0].channels)
    assert names == {"Y", "variance", "dark", "flat"}
    np.testing.assert_array_equal(
        exr.read(tmp_path / "stack.exr")[0].channels["Y"].ravel(), first.recording.digital[:25]
    )
    kept, whole = again.restrict(("A", "C")), first.restrict(("A", "C"))
    assert not_none(kept.recording).digital.size == kept.camera.measurements == 481
    np.testing.assert_array_equal(kept.values, whole.values)
    np.testing.assert_array_equal(not_none(kept.recording).values, kept.values)


def test_a_sensor_s_stack_without_frames_is_refused(tmp_path: Path) -> None:
    path, first = tmp_path / "stack.exr", sensor_example()
    stack.write(path, Stack(first.scene, first.camera, first.values, first.rendering_variance, first.record))
    with pytest.raises(InputError, match="should hold Y, variance, dark and flat"):
        stack.read(path)
    stack.write(path, first)
    parts = exr.read(path)
    for wrong in (None, "7", 0.0, -1.0):
        parts[3].record["flat_value"] = wrong
        exr.write(path, parts)
        with pytest.raises(InputError, match=r"part 'A\.01\.00' should say flat_value"):
            stack.read(path)


@pytest.mark.parametrize("key", ["surfaces", "shape"])
def test_a_stack_names_no_file_that_is_read(key: str, tmp_path: Path) -> None:
    first = example()
    lenses = (first.scene.camera.lens[0].model_copy(update={"surfaces": "/dev/zero"}), *first.scene.camera.lens[1:])
    changes = {"surfaces": {"camera": {"lens": lenses}}, "shape": {"target": {"shape": None}}}[key]
    stack.write(tmp_path / "s.exr", replace(first, scene=with_keys(first.scene, **changes)))
    with pytest.raises(InputError, match="expected a scene with"):
        stack.read(tmp_path / "s.exr")
