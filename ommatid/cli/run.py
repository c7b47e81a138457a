"""Commands on whole scenes, one or many: run and render."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from . import failures, options, output
from .options import (
    Baselines,
    DryRun,
    Folder,
    Force,
    Formats,
    Jobs,
    Json,
    Printing,
    SceneFiles,
    Strict,
    Sweeps,
    Within,
    WorldChanges,
)

if TYPE_CHECKING:
    from ommatid.batch.batch import Member

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
    from ommatid.pipeline.time_budget import check_within, stages_within

    detail, (others, figures) = printing.detail, options.formats(formats)
    members, words = share_of_job(jobs.job, batch_members(scenes, folder, sweep, *changes.both), jobs.scheduler)
    output.warn_all(batch_warnings(members))
    if dry_run:
        _print_plans(members, force, printing.as_json)
        return
    work, check, (cluster, workers) = stages.run, stages.check_run, jobs.pool
    if within:
        time = options.seconds(within)
        work = stages_within(time, members, STARTED, output.warn, jobs.scheduler, workers)
        check, workers = check_within, 1
    work = stages.SceneWork(work, check if force else None, others, figures, baselines)
    files = BatchFiles(None if jobs.job else folder, folder, figures)
    with output.batch_bars(len(members), printing.quiet) as bars:
        batch = Batch(work, bars.observer, partial(_print_run, detail, bars))
        outcome = run_batch(batch, members, failures.report, cluster, workers, bars.progress, files=files)
    failures.finish_batch(outcome, printing.as_json, strict, words)


def _print_run(
    detail: output.Detail | None, bars: output.Bars, member: Member, description: dict[str, Any]
) -> dict[str, Any]:
    """Print a finished scene, unless `detail` is None, and return its description."""
    from ommatid.pipeline.sections import run_sections
    from ommatid.reconstruct.output.run_json import RunReport

    if detail is not None:
        report = RunReport.model_validate(description)
        page, sections = member.folder / "report.html", run_sections(member.folder, description)
        with bars.hidden():
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
    check, files = stages.check_render if force else None, BatchFiles(None if jobs.job else folder)
    with output.batch_bars(len(members)) as bars:
        batch = Batch(stages.SceneWork(stages.render, check), bars.observer, report)
        outcome = run_batch(batch, members, failures.report, *jobs.pool, bars.progress, files=files)
    failures.finish_batch(outcome, as_json, job_words=words)
