"""Commands on whole scenes: run, render and predict, of one or many, and design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ommatid.runtime.errors import InputError

from . import failures, options, output
from .options import (
    Baselines,
    Changes,
    DryRun,
    Folder,
    FolderIfAny,
    Force,
    Formats,
    Jobs,
    Json,
    Printing,
    SceneFile,
    SceneFiles,
    Strict,
    Sweeps,
    Within,
    WorldChanges,
)

if TYPE_CHECKING:
    from ommatid.analysis.summary import Section
    from ommatid.batch.batch import Member

NoRays = Annotated[bool, typer.Option("--no-rays", help="A perfect H and a perfect rendering: Eq. 5 without rays.")]
Steer = Annotated[
    str,
    typer.Option(
        "--steer",
        metavar="RUN|ROW,COLUMN,ROWS,COLUMNS",
        help="Place windows where they lower the errors of a run or a region most.",
    ),
]
STARTED = perf_counter()  # from which --within counts


def run(
    scenes: SceneFiles,
    changes: WorldChanges,
    jobs: Jobs,
    printing: Printing,
    folder: Folder = Path("out"),
    sweep: Sweeps = None,
    within: Within = "",
    baselines: Baselines = False,
    formats: Formats = "",
    force: Force = False,
    dry_run: DryRun = False,
    strict: Strict = False,
) -> None:
    """Render, calibrate, reconstruct and report."""
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import Batch, BatchFiles, batch_members, batch_warnings, run_batch, share_of_job

    detail, (others, figures) = printing.detail, options.formats(formats)
    members, words = share_of_job(jobs.job, batch_members(scenes, folder, sweep, *changes.both), jobs.scheduler)
    output.warn_all(batch_warnings(members))
    if dry_run:
        _print_plans(members, force, printing.as_json)
        return
    run_scene, (cluster, workers) = partial(stages.run, force=force, baselines=baselines), jobs.pool
    if within:
        if cluster is not None or workers is not None:
            raise InputError("--within divides the time of one process; leave out --scheduler and --workers")
        folders = [member.folder for member in members]
        from ommatid.pipeline.time_budget import TimeBudget

        seconds, workers = options.seconds(within), 1
        run_scene = TimeBudget(seconds, folders, STARTED, output.warn, force=force, baselines=baselines)
    work = stages.SceneWork(run_scene, others, figures)
    files = BatchFiles(None if jobs.job else folder, folder, figures)
    with output.batch_bars(len(members), printing.quiet) as bars:
        batch = Batch(work, bars.observer, partial(_print_run, detail, bars))
        outcome = run_batch(batch, members, failures.report, cluster, workers, bars.progress, files=files)
    failures.finish_batch(outcome, printing.as_json, strict, words)


def _print_run(
    detail: output.Detail | None, bars: output.Bars, member: Member, description: dict[str, Any]
) -> dict[str, Any]:
    """Print a finished scene, unless `detail` is None, and return its description."""
    if detail is None:
        return description
    from ommatid.reconstruct.output.run_json import RunReport

    report = RunReport.model_validate(description)
    sections: list[Section] = []
    if detail == "table" or report.study:
        from ommatid.pipeline.sections import run_sections

        sections = run_sections(member.folder, report)
    with bars.hidden():
        output.print_report(member.folder.name, member.folder / "report.html", report, sections, detail)
        if detail == "summary" and report.study:  # asked for by the scene
            output.print_tables(sections[-1:])
    return description


def _print_plans(members: Sequence[Member], force: bool, as_json: bool) -> None:
    """Print what a run would do. Raises InputError for the first scene that would fail."""
    from ommatid.batch import plan
    from ommatid.pipeline.stages import open_member

    plans = [plan.plan(member, open_member(member), force) for member in members]
    if as_json:
        output.print_json(
            [{"scene": str(member.scene), **described} for member, described in zip(members, plans, strict=True)]
        )
        return
    for member, described in zip(members, plans, strict=True):
        output.print_lines(plan.lines(member.folder.name, described))


def render(
    scenes: SceneFiles,
    changes: WorldChanges,
    jobs: Jobs,
    folder: Folder = Path("out"),
    sweep: Sweeps = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Render the sub-images alone."""
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import Batch, BatchFiles, batch_members, batch_warnings, run_batch, share_of_job

    def report(member: Member, description: dict[str, Any]) -> dict[str, Any]:
        return {"file": str(member.folder / "stack.exr"), **description}

    members, words = share_of_job(jobs.job, batch_members(scenes, folder, sweep, *changes.both), jobs.scheduler)
    output.warn_all(batch_warnings(members))
    files = BatchFiles(None if jobs.job else folder)
    with output.batch_bars(len(members)) as bars:
        batch = Batch(stages.SceneWork(partial(stages.render, force=force)), bars.observer, report)
        outcome = run_batch(batch, members, failures.report, *jobs.pool, bars.progress, files=files)
    failures.finish_batch(outcome, as_json, job_words=words)


def predict(
    scenes: SceneFiles,
    changes: Changes,
    printing: Printing,
    sweep: Sweeps = None,
    folder: FolderIfAny = None,
    no_rays: NoRays = False,
    formats: Formats = "",
) -> None:
    """Predict the error, the rank and the null space of H, and compare several scenes.

    From Eq. 5, and a few rays where they matter: no picture is rendered.
    """
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import Batch, BatchFiles, batch_members, batch_warnings, run_batch
    from ommatid.pipeline.sections import predicted_lines, predicted_sections

    if folder is not None and not sweep:
        raise InputError("predict: -o is for the table and the plot of a --sweep; name keys to sweep, or leave it out")
    detail, figures = printing.detail, options.figure_files(formats)
    members = batch_members(scenes, Path(), sweep, *changes.both)
    output.warn_all(batch_warnings(members))
    with output.batch_bars(len(members), printing.quiet) as bars:
        predicted = partial(stages.predict_scene, rays=not no_rays)
        batch = Batch(predicted, bars.observer, lambda _, description: description)
        files = BatchFiles(folder, None, figures)
        outcome = run_batch(batch, members, failures.report, progress=bars.progress, files=files, with_folders=False)
    sections = predicted_sections(members, outcome, detail)
    if detail == "verdict":
        output.print_lines(predicted_lines(outcome.documents))
    failures.finish_batch(replace(outcome, sections=sections), printing.as_json)


def design(
    scene: SceneFile,
    changes: Changes,
    steer: Steer = "",
    folder: FolderIfAny = None,
    formats: Formats = "",
    as_json: Json = False,
) -> None:
    """Choose the best camera of the lens types of [design], with a bound on every other choice."""
    from ommatid.pipeline.design import prove_best_camera, steer_windows
    from ommatid.scenes.scene import read

    figures = options.figure_files(formats)
    described = read(scene, *changes.both)
    title = described.title or scene.stem
    with output.progress_bar("design") as progress:
        if steer:
            document, rows = steer_windows(described, steer, folder, figures)
            title = f"{title}: windows of further sub-imagers"
        else:
            document, rows = prove_best_camera(described, folder, figures, progress)
            title = f"{title}: the best camera"
    output.print_result(document, [(title, rows)], as_json)
