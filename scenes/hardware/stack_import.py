"""Recorded frames of a real camera as a stack of sub-images, which is reconstructed as a rendered one is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import fingerprint
from ommatid.runtime.versions import versions

from ..recording import Recording
from ..setup import Setup
from ..stack import Stack, stack_from_recording
from ..tables.sensor import SensorTable
from .frames import AcquisitionSettings, RecordedFrames, read_frames


def import_stack(setup: Setup, images: Sequence[Path], bench: AcquisitionSettings) -> tuple[Stack, RecordedFrames]:
    """The stack that recorded images make, and what it was cut from.

    images : one mosaic, or one picture a sub-imager in the order of measurements
    The variance is a rendering's and so 0; dead pixels are NaN. Raises InputError for what cannot be cut.
    """
    camera, start = setup.camera, perf_counter()
    frames = read_frames(camera, images, bench, mosaics=False)
    made_from = {"camera": camera.describe(), "bench": bench.describe(), "source": frames.sources}
    record = {
        "fingerprint": fingerprint(made_from),
        "method": "imported",
        "source": frames.sources,
        "seconds": perf_counter() - start,
        "versions": versions("scikit-image", "OpenEXR"),
    }
    kept, none = setup.resolved, np.zeros(camera.measurements)
    if kept.sensor is None:
        return Stack(kept, camera, _as_stored(frames.values()[0]), none, record), frames
    recording = _recording(kept.source, kept.sensor, frames)
    kept = kept.model_copy(update={"sensor": recording.sensor})
    return stack_from_recording(kept, camera, recording, none, record), frames


def _recording(source: Path, sensor: SensorTable, frames: RecordedFrames) -> Recording:
    """Digital numbers as they are. What is one dark and one flat frame is taken for the mean that [sensor] tells of."""
    if frames.dark is None or frames.flat is None:
        raise InputError(
            f"{source}: what a [sensor] records is told from its dark and its flat frames; give them with --dark and"
            " --flat, or remove [sensor]"
        )
    if frames.averaged > 1:
        sensor = sensor.model_copy(update={"frames": frames.averaged})
    digital, dark, flat = (_as_stored(numbers) for numbers in (frames.numbers[0], frames.dark, frames.flat))
    return Recording(sensor, digital, dark, flat, np.full(digital.size, frames.settings.flat_value))


def _as_stored(values: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(over="ignore"):  # what the file cannot hold is as dead as what is infinite
        return values.astype(np.float32).astype(np.float64)
