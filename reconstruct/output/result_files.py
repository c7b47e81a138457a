"""The files of a reconstruction: estimate.exr, the pictures beside it, and run.json."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import cached, digest, fingerprint
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.workers import Workers
from ommatid.scenes.formats.exr import read
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH, Scene, with_changes
from ommatid.scenes.stack import Stack

from ..restore import Reconstruction, check_match, restore
from . import figures, run_json

ESTIMATE, PICTURE, OVERVIEW, RUN = "estimate.exr", "estimate.png", "overview.png", "run.json"
OURS = ("prior", "estimator", "tiles")


def changed(stack: Stack, overrides: list[str], path: Path) -> Stack:
    """The stack with what its scene tells the estimator changed. Raises InputError for any other key."""
    if not overrides:
        return stack
    scene = with_changes(stack.scene.plain(), path, overrides, ())
    for override in overrides:
        table = override.partition("=")[0].split(".")[0].strip()
        if table not in OURS:
            raise InputError(f"--set: [{table}] is already recorded in {path}; here only {', '.join(OURS)} can be set")
    return replace(stack, scene=_with(stack.scene, scene))


def _with(recorded: Scene, told: Scene) -> Scene:
    return recorded.model_copy(update={table: getattr(told, table) for table in OURS})


def truth_beside(path: Path, stack: Stack) -> NDArray[np.float64] | None:
    """The target, (N,), from truth.exr in the stack's folder if it is the one that was rendered; else None."""
    try:
        truth = read(path.parent / TRUTH)[0].channels["Y"]
    except (InputError, KeyError):
        return None
    return truth.astype(np.float64).ravel() if digest(truth) == stack.record.get("truth") else None


def reconstruct(
    stack: Stack,
    model: Model,
    truth: NDArray[np.float64] | None,
    names: tuple[Path, Path],
    workers: Workers | None = None,
    progress: Progress = no_progress,
) -> tuple[Reconstruction, dict[str, Any]]:
    """The estimate and what run.json says of it. Raises InputError if stack and model do not belong together."""
    check_match(stack, model, names)
    restoration = restore(stack, model, truth, workers, progress)
    return restoration, run_json.describe(stack, model, restoration)


def write_results(folder: Path, stack: Stack, restoration: Reconstruction, description: dict[str, Any]) -> None:
    """Write the four files of a run; run.json comes last and so stands for all. Raises DeniedError."""
    record = {"title": stack.scene.title, "fingerprint": description["fingerprint"]}
    run_json.write_estimate(folder / ESTIMATE, restoration, record)
    figures.write_estimate(folder / PICTURE, restoration.estimate.reshape(restoration.shape))
    figures.write_overview(folder / OVERVIEW, stack.scene.title, stack, restoration)
    run_json.write_run(folder / RUN, description)


def _of(model: Model) -> tuple[NDArray[Any], ...]:
    entries = () if model.stored is None else (model.stored.data, model.stored.indices, model.stored.indptr)
    return (*entries, model.variance, model.batches)


def made_from(stack: Stack, model: Model) -> str:
    """Fingerprint of everything that an estimate depends on."""
    arrays = (stack.values, stack.variance, *_of(model))
    records = [stack.record, model.record]
    return fingerprint([digest(*arrays), records, stack.scene.plain()])


def _read_results(folder: Path) -> tuple[dict[str, Any], str | None]:
    """run.json, and its fingerprint if all results are there, whole and of one reconstruction."""
    description: dict[str, Any] = json.loads((folder / RUN).read_text(encoding="utf-8"))
    made_from = read(folder / ESTIMATE)[0].record["fingerprint"]
    whole = description["fingerprint"] == made_from and all((folder / name).is_file() for name in (PICTURE, OVERVIEW))
    return description, made_from if whole else None


def cached_results(
    folder: Path, stack: Stack, model: Model, names: tuple[Path, Path], progress: Progress = no_progress
) -> tuple[dict[str, Any], bool]:
    """What run.json in `folder` says, and whether the reconstruction had to be made for it."""
    wanted = made_from(stack, model)

    def make() -> tuple[Reconstruction, dict[str, Any]]:
        restoration, description = reconstruct(stack, model, truth_beside(names[0], stack), names, None, progress)
        return restoration, {"fingerprint": wanted, **description}

    return cached(folder, wanted, _read_results, make, lambda _, made: write_results(folder, stack, *made))
