"""The observation matrix H of a scene file, simulated or from recorded point sources, as a separate file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ommatid.analysis.recording_warnings import calibration_warnings
from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import write_whole
from ommatid.runtime.outputs.kinds import check_output
from ommatid.runtime.progress import Progress
from ommatid.scenes import model_file
from ommatid.scenes.hardware.frames import AcquisitionSettings, files_in
from ommatid.scenes.hardware.point_sources import from_recorded_points
from ommatid.scenes.model import Model
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.gallery import find_scene

from .stages import calibrated_model


@dataclass(frozen=True)
class PointRecording:
    """Recorded frames of point sources of one `value`; `positions` is a CSV file, None for a scan by rows."""

    images: tuple[Path, ...]
    settings: AcquisitionSettings
    positions: Path | None
    value: float

    @property
    def files(self) -> list[Path]:
        """All input files."""
        frames = (*self.images, *self.settings.dark, *self.settings.flat)
        return [*(file for path in frames for file in files_in(path)), *([self.positions] if self.positions else [])]


@dataclass(frozen=True)
class CalibrationOutcome:
    """A model, True if it had to be made, and warnings about the recorded frames."""

    model: Model
    made: bool
    warnings: list[str]

    def describe(self) -> dict[str, Any]:
        """Describe the model in JSON's types."""
        model = self.model
        sizes = {"measurements": model.measurements, "unknowns": model.unknowns, "entries": model.entries}
        return {**sizes, **model.record}


def point_recording(
    points: Sequence[Path], more: Sequence[Path], positions: Path | None, value: float, settings: AcquisitionSettings
) -> PointRecording | None:
    """Collect the recorded point sources; None if there are none.

    Raises InputError for other files or settings of recorded frames without `points`.
    """
    if points:
        return PointRecording((*points, *more), settings, positions, value)
    if more or positions or settings.dark or settings.flat or settings.origin:
        raise InputError("calibrate: images, --places, --dark, --flat and --origin belong to --points; name its images")
    return None


def calibrate_file(
    path: Path,
    output: Path,
    changes: Sequence[str],
    lenses: Sequence[str],
    recording: PointRecording | None,
    progress: Progress,
) -> CalibrationOutcome:
    """Calibrate the scene in `path` and write the model to `output`, unless a model there is up to date.

    Raises InputError for a wrong scene, option or frame, MachineError for a full disk.
    """
    check_output(output, find_scene(path))
    setup = Setup.from_scene(read(path, changes, lenses))
    if recording is not None:
        if lenses:
            raise InputError("--lens: recorded frames are of the whole camera; choose lens types in `reconstruct`")
        return _from_points(setup, output, recording)
    with naming_source(path):
        return CalibrationOutcome(*calibrated_model(setup, output, progress), warnings=[])


def export_matrix(model: Path, output: Path) -> dict[str, int]:
    """Write H of a model file as SciPy's sparse matrix, and return its size. Raises InputError or MachineError."""
    from scipy import sparse

    check_output(output, model)
    stored = model_file.read(model).to_sparse()

    def fill(beside: Path) -> None:
        with beside.open("wb") as stream:
            sparse.save_npz(stream, stored, compressed=False)

    write_whole(output, fill)
    return {"measurements": stored.shape[0], "unknowns": stored.shape[1], "entries": int(stored.nnz)}


def _from_points(setup: Setup, output: Path, recording: PointRecording) -> CalibrationOutcome:
    check_output(output, *recording.files)
    outcome = from_recorded_points(setup, recording.images, recording.settings, recording.positions, recording.value)
    model_file.write(output, outcome.model)
    return CalibrationOutcome(outcome.model, True, calibration_warnings(outcome))
