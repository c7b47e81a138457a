"""Commands on whole scenes, one or many: run and render."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from . import failures, output
from .options import (
    SCREEN,
    Complete,
    FigureFormats,
    FigureResolution,
    Folder,
    Json,
    Lenses,
    SceneFiles,
    Scheduler,
    Sets,
    Strict,
    Sweeps,
    Within,
    Workers,
    changes,
    figure_files,
    lens_names,
)

if TYPE_CHECKING:
    from ommatid.batch.batch import Member
    from ommatid.pipeline.batches import BatchOutcome

STARTED = perf_counter()  # from which --within counts


def run(
    scenes: SceneFiles,
    folder: Folder = Path("out"),
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    scheduler: Scheduler = "",
    workers: Workers = None,
    complete: Complete = False,
    within: Within = "",
    figure_formats: FigureFormats = "",
    figure_resolution: FigureResolution = SCREEN,
    strict: Strict = False,
    as_json: Json = False,
) -> None:
    """Render, calibrate, reconstruct and report."""
    from ommatid.pipeline.batches import batch_members, run_batch, scene_batch
    from ommatid.pipeline.sections import run_sections
    from ommatid.pipeline.stages import with_figures
    from ommatid.pipeline.time_budget import stages_within

    def report(member: Member, description: dict[str, Any]) -> dict[str, Any]:
        output.print_tables([] if as_json else run_sections(member.folder, description))
        return description

    figures = figure_files(figure_formats, figure_resolution)
    asked = changes(sets, complete), lens_names(lens)
    members = batch_members(scenes, folder, sweep, *asked)
    stages, workers = stages_within(within, members, STARTED, output.say, scheduler, workers)
    observer = partial(output.observer, alone=len(members) == 1)
    batch = scene_batch(*asked, with_figures(stages, figures), observer, report)
    folders: dict[str, Any] = {"sweep_folder": folder, "index_folder": folder, "figures": figures}
    outcome = run_batch(batch, members, failures.report, scheduler, workers, **folders)
    finish_batch(outcome, as_json, strict)


def render(
    scenes: SceneFiles,
    folder: Folder = Path("out"),
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    scheduler: Scheduler = "",
    workers: Workers = None,
    complete: Complete = False,
    as_json: Json = False,
) -> None:
    """Render the sub-images alone."""
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import batch_members, run_batch, scene_batch

    def report(member: Member, description: dict[str, Any]) -> dict[str, Any]:
        return {"file": str(member.folder / "stack.exr"), **description}

    asked = changes(sets, complete), lens_names(lens)
    members = batch_members(scenes, folder, sweep, *asked)
    batch = scene_batch(*asked, stages.render, output.observer, report)
    finish_batch(run_batch(batch, members, failures.report, scheduler, workers, sweep_folder=folder), as_json)


def finish_batch(outcome: BatchOutcome, as_json: bool, strict: bool = False) -> None:
    """Print the documents of a batch, or the table of a sweep.

    Raises BatchError if a scene failed or, if `strict`, if the results of one are not to be trusted.
    """
    output.print_result(outcome.documents, outcome.sections, as_json)
    verdicts = [document["verdict"]["trusted"] for document in outcome.documents if "verdict" in document]
    code = max(outcome.exit_code, failures.NOT_TRUSTED if strict and not all(verdicts) else 0)
    if code:
        raise failures.BatchError(code)
