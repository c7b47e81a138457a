"""Commands on whole scenes, one or many: run and render."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from . import failures, output
from .options import (
    SCREEN,
    AllowOutside,
    DryRun,
    FigureFormats,
    FigureResolution,
    Folder,
    Force,
    Formats,
    Job,
    Json,
    Lenses,
    Quiet,
    SceneFiles,
    Scheduler,
    Sets,
    Strict,
    Sweeps,
    Verbose,
    Within,
    Workers,
    changes,
    cluster,
    figure_files,
    lens_names,
)

if TYPE_CHECKING:
    from ommatid.batch.batch import Member

STARTED = perf_counter()  # from which --within counts


def run(
    scenes: SceneFiles,
    folder: Folder = Path("out"),
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    scheduler: Scheduler = "",
    workers: Workers = None,
    job: Job = "",
    allow_outside: AllowOutside = False,
    within: Within = "",
    figure_formats: FigureFormats = "",
    figure_resolution: FigureResolution = SCREEN,
    formats: Formats = "",
    force: Force = False,
    dry_run: DryRun = False,
    strict: Strict = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Render, calibrate, reconstruct and report."""
    from ommatid.batch.batch import with_options
    from ommatid.pipeline.batches import batch_members, batch_warnings, run_batch, scene_batch, share_of_job
    from ommatid.pipeline.stages import check_run, with_figures
    from ommatid.pipeline.time_budget import check_within, stages_within
    from ommatid.reconstruct.output.estimate_formats import formats_of

    detail, others = output.detail(verbose, quiet), formats_of(formats)
    figures = figure_files(figure_formats, figure_resolution)
    asked = changes(sets, allow_outside), lens_names(lens)
    members, job_words = share_of_job(job, batch_members(scenes, folder, sweep, *asked), scheduler)
    output.warn_all(batch_warnings(members))
    if dry_run:
        _print_plans(members, force, as_json)
        return
    stages, workers = stages_within(within, members, STARTED, output.warn, scheduler, workers)
    pool = cluster(scheduler), workers
    observer = partial(output.observer, alone=len(members) == 1, quiet=quiet)
    check = (check_within if within else check_run) if force else None
    stages, report = with_figures(stages, figures), partial(_print_run, None if as_json else detail)
    batch = scene_batch(with_options(stages, check, others), observer, report)
    files: dict[str, Any] = {"sweep_folder": None if job else folder, "index_folder": folder, "figures": figures}
    failures.finish_batch(run_batch(batch, members, failures.report, *pool, **files), as_json, strict, job_words)


def _print_run(detail: output.Detail | None, member: Member, description: dict[str, Any]) -> dict[str, Any]:
    """Print a finished scene, unless `detail` is None, and return its description."""
    from ommatid.pipeline.sections import run_sections
    from ommatid.reconstruct.output.run_json import RunReport

    if detail is not None:
        report = RunReport.model_validate(description)
        page, sections = member.folder / "report.html", run_sections(member.folder, description)
        output.print_report(member.folder.name, page, report, sections, detail)
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
    folder: Folder = Path("out"),
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    scheduler: Scheduler = "",
    workers: Workers = None,
    job: Job = "",
    allow_outside: AllowOutside = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Render the sub-images alone."""
    from ommatid.batch.batch import with_options
    from ommatid.pipeline import stages
    from ommatid.pipeline.batches import batch_members, batch_warnings, run_batch, scene_batch, share_of_job

    def report(member: Member, description: dict[str, Any]) -> dict[str, Any]:
        return {"file": str(member.folder / "stack.exr"), **description}

    asked = changes(sets, allow_outside), lens_names(lens)
    members, job_words = share_of_job(job, batch_members(scenes, folder, sweep, *asked), scheduler)
    output.warn_all(batch_warnings(members))
    check = stages.check_render if force else None
    batch = scene_batch(with_options(stages.render, check, ()), output.observer, report)
    pool = cluster(scheduler), workers
    outcome = run_batch(batch, members, failures.report, *pool, sweep_folder=None if job else folder)
    failures.finish_batch(outcome, as_json, job_words=job_words)
