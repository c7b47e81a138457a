"""Files of a scene's camera: recorded frames imported as a stack, and H, simulated or from recorded point sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import write_whole
from ommatid.runtime.outputs.kinds import check_output, check_suffix
from ommatid.runtime.progress import Progress
from ommatid.scenes import model_file, stack
from ommatid.scenes.hardware.frames import AcquisitionSettings, RecordedFrames, files_in, import_stack
from ommatid.scenes.hardware.point_sources import RecordedCalibration, from_recorded_points
from ommatid.scenes.model import Model
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.gallery import find_scene

from .stages import calibrated_model


def import_file(
    path: Path,
    images: Sequence[Path],
    output: Path,
    settings: AcquisitionSettings,
    changes: Sequence[str],
    lenses: Sequence[str],
) -> tuple[dict[str, Any], list[str]]:
    """Cut frames that the camera of the scene in `path` recorded into sub-images, and write the stack to `output`.

    Returns the stack in JSON's types, with its distance from whole pixels of the mosaic in sensor pixels, and warnings.
    Raises InputError for a wrong scene or frame, MachineError for a full disk.
    """
    frames = (*images, *settings.dark, *settings.flat)
    check_suffix(output, ".exr", "a stack")
    check_output(output, find_scene(path), *(file for frame in frames for file in files_in(frame)))
    setup = Setup.from_scene(read(path, changes))  # with all lens types, since all of them are on the sensor
    if lenses and not setup.camera.is_ideal_pinhole:
        raise InputError(
            f"--lens {','.join(lenses)}: lenses that are more than pinholes are imported all; choose in `reconstruct`"
        )
    whole, recorded = import_stack(setup, images, settings)
    kept = whole.restrict(tuple(lenses)) if lenses else whole
    stack.write(output, kept)
    sizes = {"sub_images": len(kept.camera.sub_imagers), "beside_pixels": recorded.layout.beside}
    return {**sizes, **kept.record}, import_warnings(recorded)


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
) -> tuple[Model, bool, list[str]]:
    """Calibrate the scene in `path` and write the model to `output`, unless a model there is up to date.

    Returns the model, True if it had to be made, and warnings about the recorded frames.
    Raises InputError for a wrong scene, option or frame, MachineError for a full disk.
    """
    check_suffix(output, ".npz", "a model")
    check_output(output, find_scene(path))
    setup = Setup.from_scene(read(path, changes, lenses))
    if recording is not None:
        if lenses:
            raise InputError("--lens: recorded frames are of the whole camera; choose lens types in `reconstruct`")
        return _from_points(setup, output, recording)
    with naming_source(path):
        return *calibrated_model(setup, output, progress), []


def export_matrix(model: Path, output: Path) -> dict[str, int]:
    """Write H of a model file as SciPy's sparse matrix, and return its size. Raises InputError or MachineError."""
    from scipy import sparse

    check_suffix(output, ".npz", "a matrix")
    check_output(output, model)
    stored = model_file.read(model).to_sparse()

    def fill(beside: Path) -> None:
        with beside.open("wb") as stream:
            sparse.save_npz(stream, stored, compressed=False)

    write_whole(output, fill)
    return {"measurements": stored.shape[0], "unknowns": stored.shape[1], "entries": int(stored.nnz)}


def _from_points(setup: Setup, output: Path, recording: PointRecording) -> tuple[Model, bool, list[str]]:
    check_output(output, *recording.files)
    outcome = from_recorded_points(setup, recording.images, recording.settings, recording.positions, recording.value)
    model = outcome.model
    if setup.scene.calibration.fit != "none" and setup.camera.walls:
        from ommatid.simulate.calibration.fit.recorded import fit_recorded

        model = fit_recorded(model)
    model_file.write(output, model)
    return model, True, calibration_warnings(outcome)


TURNED = 1.1  # light at the sub-images of a mosaic turned by 180 degrees, over that of the mosaic
WORST_OFFSET = 0.1  # sensor pixels between a patch and the whole pixels cut out for it; beyond, the design's H misleads
ROW_SUM_ERROR = 0.2  # by which the median row sum of a calibrated H may differ from 1


def import_warnings(frames: RecordedFrames) -> list[str]:
    """Warnings about frames that are imported as a stack."""
    warnings = list(frames.notes)
    if frames.layout.beside > WORST_OFFSET:
        warnings.append(
            f"the sub-images lie up to {frames.layout.beside:.2f} sensor pixels beside whole pixels of the mosaic, so"
            " the H of the design does not hold: calibrate it from recorded points (ommatid calibrate --points)"
        )
    if frames.layout.turned > TURNED:
        warnings.append(
            f"turned by 180 degrees, the mosaic has {frames.layout.turned:.2g} times as much light where the sub-images"
            " are expected: turn all frames, or give --origin if the sensor is displaced"
        )
    if frames.dark is not None and frames.flat is None:
        warnings.append(
            "--dark without --flat: a number of the sensor is taken for a grey level of f; add flat frames of a"
            " uniform target, of --flat-value"
        )
    if frames.flat is not None and frames.dark is None:
        warnings.append("--flat without --dark: the black level of the sensor counts as light; add dark frames")
    return [*warnings, *_dead_pixels(frames)]


def calibration_warnings(calibrated: RecordedCalibration) -> list[str]:
    """Warnings about an H that was calibrated from recorded point sources."""
    warnings = [*calibrated.frames.notes, *_dead_pixels(calibrated.frames)]
    sums = np.asarray(calibrated.model.matrix.sum(axis=1)).ravel()
    typical = float(np.median(sums[sums > 0])) if (sums > 0).any() else 0.0
    if abs(typical - 1) > ROW_SUM_ERROR:
        warnings.append(
            f"all points together give a sensor pixel {typical:.3g} of the value of one, expected about 1: check"
            " --point-value, and pass dark and flat frames with --dark and --flat"
        )
    if calibrated.once:
        warnings.append(
            "every point was recorded once, so the variance of H holds the noise of the dark but no photon noise:"
            " record each point twice or more, or describe the sensor in [sensor]"
        )
    if calibrated.stray:
        warnings.append(
            f"{calibrated.stray} readings beyond the footprints exceed the noise and belong to no point: show fewer"
            " points at once, or look for stray light"
        )
    return warnings


def _dead_pixels(frames: RecordedFrames) -> list[str]:
    count = int(np.sum(~np.isfinite(frames.scale)))
    warnings = [f"{count} sensor pixels are dead: their flat frame is not above the dark one"] if count else []
    if frames.not_numbers:
        warnings.append(
            f"{frames.not_numbers} sensor pixels have NaN, infinite or too large numbers: they count as dead"
        )
    return warnings
