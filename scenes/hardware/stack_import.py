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
from ..stack import Stack, recorded
from ..tables.sensor import SensorTable
from .frames import AcquisitionSettings, RecordedFrames, read_frames

FAR = 0.1  # sensor pixels beside whole ones, above which H of the design is not that of the frames


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
    return recorded(kept, camera, recording, none, record), frames


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


def warnings(frames: RecordedFrames) -> list[str]:
    """What the user should know of the frames, a sentence each."""
    said: list[str] = []
    if frames.layout.beside > FAR:
        said.append(
            f"the sub-images stand up to {frames.layout.beside:.2f} sensor pixels beside whole pixels of the mosaic, so"
            " that H of the design is not theirs: calibrate it from recorded points (ommatid calibrate --points)"
        )
    return [*said, *dead(frames)]


def dead(frames: RecordedFrames) -> list[str]:
    """A sentence where pixels are dead."""
    count = int(np.sum(~np.isfinite(frames.scale)))
    return [f"{count} sensor pixels are dead: their flat frame is not above the dark one"] if count else []
