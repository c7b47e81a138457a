"""The held-out check from the files of a stack and a model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ommatid.reconstruct.held_out.check import check_held_out
from ommatid.reconstruct.output.result_files import with_estimator_changes
from ommatid.reconstruct.output.run_json import HeldOutReport
from ommatid.reconstruct.restore import check_match
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file


def check_files(
    stack: Path,
    model: Path,
    changes: Sequence[str] = (),
    lenses: Sequence[str] = (),
    *,
    fitted: bool = True,
    progress: Progress = no_progress,
) -> HeldOutReport:
    """Predict every sub-imager of a stack from all others.

    fitted : True replaces an independent prior by one fitted to the stack
    Raises InputError for wrong files and options, and for a scene without noise.
    """
    recorded, calibrated = stack_file.read(stack), model_file.read(model)
    if lenses:
        recorded, calibrated = recorded.restrict(tuple(lenses)), calibrated.restrict(tuple(lenses))
    recorded = with_estimator_changes(recorded, list(changes), stack)
    check_match(recorded, calibrated, (stack, model))
    return check_held_out(recorded, calibrated, fitted=fitted, progress=progress)
