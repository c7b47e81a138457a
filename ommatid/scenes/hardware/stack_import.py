"""Import of a real camera's frames as a stack of sub-images, which is reconstructed like a rendered one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import fingerprint
from ommatid.runtime.versions import versions

from ..recording import Recording
from ..setup import Setup
from ..stack import Stack, stack_from_recording
from ..tables.sensor import SensorTable
from .frames import AcquisitionSettings, RecordedFrames, read_frames


def import_stack(setup: Setup, images: Sequence[Path], settings: AcquisitionSettings) -> tuple[Stack, RecordedFrames]:
    """Read recorded images as a stack; also return the frames.

    images : one mosaic, or one picture per sub-imager in the order of measurements
    The stack's variance, which is that of a rendering, is 0; dead pixels are NaN. Raises InputError for images that do
    not fit the camera.
    """
    camera, start = setup.camera, perf_counter()
    frames = read_frames(camera, images, settings, mosaics=False)
    made_from = {"camera": camera.describe(), "bench": settings.describe(), "source": frames.sources}
    record = {
        "fingerprint": fingerprint(made_from),
        "method": "imported",
        "flat": frames.flat is not None,
        "source": frames.sources,
        "seconds": perf_counter() - start,
        "versions": versions("scikit-image", "OpenEXR"),
    }
    stored, zeros = setup.resolved, np.zeros(camera.measurements)
    if stored.sensor is None:
        return Stack(stored, camera, _as_float32(frames.values()[0]), zeros, record), frames
    recording = _recording(stored.source, stored.sensor, frames)
    stored = stored.model_copy(update={"sensor": recording.sensor})
    return stack_from_recording(stored, camera, recording, zeros, record), frames


def _recording(source: Path, sensor: SensorTable, frames: RecordedFrames) -> Recording:
    """The recording of unscaled digital numbers.

    A single dark or flat frame is taken for the mean of `sensor.frames`; of several, their number is used instead.
    """
    if frames.dark is None or frames.flat is None:
        raise InputError(
            f"{source}: a [sensor] needs dark and flat frames to convert its readings; pass them with --dark and"
            " --flat, or remove [sensor]"
        )
    if frames.averaged > 1:
        sensor = sensor.model_copy(update={"frames": frames.averaged})
    digital, dark, flat = (_as_float32(values) for values in (frames.numbers[0], frames.dark, frames.flat))
    return Recording(sensor, digital, dark, flat, np.full(digital.size, frames.settings.flat_value))


def _as_float32(values: FloatArray) -> FloatArray:
    """Values rounded to float32, as the file stores them; NaN beyond its range, which marks dead pixels."""
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = values.astype(np.float32).astype(np.float64)
    return np.where(np.isinf(rounded), np.nan, rounded)
