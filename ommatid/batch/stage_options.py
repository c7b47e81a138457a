"""Options of `run` that wrap the stages of a scene: make everything again, and write the estimate in more formats."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from ommatid.reconstruct.output.estimate_formats import Format, write_formats
from ommatid.scenes.scene import TRUTH
from ommatid.scenes.setup import Setup

from .remote import RunObserver, Stages

# What the stages write; the calibrated models of a study and interrupted work are beside them.
RESULTS = ("stack.exr", "model*.npz", "run.json", "estimate.exr", "study.json", "report.html", ".*.partial.npz")


def with_options(stages: Stages, force: bool, formats: tuple[Format, ...]) -> Stages:
    """Return stages that first remove the results of an earlier run, if `force`, and last write `formats`."""
    return partial(_with_options, stages, force, formats) if force or formats else stages


def _with_options(
    stages: Stages, force: bool, formats: tuple[Format, ...], setup: Setup, folder: Path, observer: RunObserver
) -> dict[str, Any]:
    if force:
        clear_results(folder, setup)
    description = stages(setup, folder, observer)
    write_formats(folder / "estimate.exr", formats)
    return description


def clear_results(folder: Path, setup: Setup) -> None:
    """Remove the results in a folder, so that all stages run again. Files that the scene is read from stay."""
    scene = setup.scene
    names = RESULTS if scene.world is None else (*RESULTS, TRUTH)
    read = {scene.source.resolve(), Path(scene.target.image or "").resolve()}
    for path in (path for name in names for path in folder.glob(name)):
        if path.resolve() not in read:
            path.unlink()
