"""Options of `run` that wrap the stages of a scene: make everything again, and write the estimate in more formats."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ommatid.reconstruct.output.estimate_formats import Format, write_formats
from ommatid.runtime.input_files import real_path
from ommatid.runtime.outputs.occupied import occupied
from ommatid.scenes.scene import TRUTH
from ommatid.scenes.setup import Setup

from .remote import RunObserver, Stages

# What the stages write; the calibrated models of a study and interrupted work are beside them.
ESTIMATES = ("estimate.exr", "estimate.npy", "estimate.tiff")
RENDERED = "stack.exr"
RESULTS = (RENDERED, "model*.npz", "run.json", *ESTIMATES, "study.json", "report.html", ".*.partial.npz")

Check = Callable[[Setup, Path], None]  # raises InputError where the stages would, and writes nothing


def with_options(stages: Stages, force: Check | None, formats: tuple[Format, ...]) -> Stages:
    """Return stages that last write `formats`, and first remove the results of an earlier run if `force` is given.

    One process at a time runs them in a folder. A scene that is refused before it is rendered leaves nothing there.

    force : check of the stages, which comes before anything is removed; None: what is up to date stays
    """
    return partial(_with_options, stages, force, formats)


def _with_options(
    stages: Stages, force: Check | None, formats: tuple[Format, ...], setup: Setup, folder: Path, observer: RunObserver
) -> dict[str, Any]:
    with occupied(folder, RENDERED):
        if force is not None:
            force(setup, folder)
            clear_results(folder, setup)
        description = stages(setup, folder, observer)
        write_formats(folder / "estimate.exr", formats)
        return description


def clear_results(folder: Path, setup: Setup) -> None:
    """Remove the results in a folder, so that all stages run again. Folders stay, and files of the scene."""
    scene = setup.scene
    names = RESULTS if scene.world is None else (*RESULTS, TRUTH)
    read = {real_path(scene.source), real_path(Path(scene.target.image or ""))}
    for path in (path for name in names for path in folder.glob(name)):
        if not path.is_dir() and real_path(path) not in read:
            path.unlink()
