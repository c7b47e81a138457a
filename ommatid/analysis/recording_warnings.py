"""Warnings about imported frames and about calibrations from recorded point sources, one sentence each."""

from __future__ import annotations

import numpy as np

from ommatid.scenes.hardware.frames import RecordedFrames
from ommatid.scenes.hardware.point_sources import RecordedCalibration

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
