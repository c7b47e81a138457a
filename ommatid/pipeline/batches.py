"""Batches of scenes as the commands ask for them, with the tables and pages that describe a whole batch."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ommatid.analysis.summary import Section
from ommatid.batch import sweep
from ommatid.batch.batch import Batch, Description, Member
from ommatid.batch.remote import RunObserver, Stages
from ommatid.batch.sweep_row import SweepRow, summary
from ommatid.batch.sweep_table import lines, write_sweep
from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.page.batch_index import cached_index, check_index
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.cluster import Cluster
from ommatid.runtime.outputs.kinds import check_folder
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.printable import printable_sentence
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.formats import picture

from .stages import library_versions, open_member, process_count


@dataclass(frozen=True)
class BatchOutcome:
    """The results of a batch: a JSON document per scene, the table of a sweep, and the worst exit code."""

    documents: list[Description]
    sections: list[Section]
    exit_code: int


def batch_members(
    scenes: Sequence[Path], folder: Path, sweeps: Sequence[str] | None, changes: Sequence[str], lenses: Sequence[str]
) -> list[Member]:
    """List every scene with every combination of swept values, each with its own folder inside `folder`.

    Raises InputError for a sweep that cannot be read, a key that no scene has, two scenes of one name, and a name
    that no folder can have.
    """
    axes = sweep.sweep_axes(sweeps or ())
    members = sweep.members(scenes, axes, folder, changes, lenses)
    for scene in scenes:
        sweep.check_keys(scene, axes, changes, lenses)
    return members


def batch_warnings(members: Sequence[Member]) -> list[str]:
    """Return what is lost when the pictures of the scenes are read, a sentence each.

    Scenes with errors have none; their errors are reported when they are run.
    """
    of_picture: dict[str | None, list[str]] = {}  # each is read once
    for member in members:
        with suppress(InputError):
            if member.content.target.image not in of_picture:
                of_picture[member.content.target.image] = picture.conversions(member.content)
    return [sentence for sentences in of_picture.values() for sentence in sentences]


def scene_batch(
    stages: Stages, observe: Callable[[Path], RunObserver], report: Callable[[Member, Description], Description]
) -> Batch:
    """Create the batch that does `stages` with every scene, and passes each result to `report`."""
    return Batch(open_member, stages, observe, report, library_versions, process_count)


def share_of_job(job: str, members: Sequence[Member], scheduler: str = "") -> tuple[list[Member], str]:
    """Return the scenes of the job that `--job` names, all without that option, and a sentence on the job.

    Raises InputError if the option cannot be read.
    """
    if not job:
        return list(members), ""
    if scheduler:
        raise InputError("--job and --scheduler: expected one of them; both distribute the scenes over machines")
    number, count = sweep.job_numbers(job, os.environ)
    share = list(members[number - 1 :: count])
    tables = "; once all jobs have ended, the same command without --job writes the table" if members[0].changes else ""
    return share, f"job {number} of {count}: {len(share)} of {len(members)} scenes{tables}"


def run_batch(
    batch: Batch,
    members: Sequence[Member],
    report_failure: Callable[[Exception], int],
    cluster: Cluster | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
    *,
    sweep_folder: Path | None = None,
    index_folder: Path | None = None,
    with_folders: bool = True,
    figures: FigureFiles = SCREEN_PNG,
) -> BatchOutcome:
    """Run every scene of a batch, even if others fail.

    report_failure : returns the exit code of an exception;  with_folders : documents of a sweep name the folders
    figures : files of the sweep's figure
    sweep_folder, index_folder : where the table of a sweep and the page of the batch are written, if anywhere
    Where all scenes fail, neither table nor page is written.
    """
    for folder in (index_folder, sweep_folder):
        if folder is not None:
            check_folder(folder)  # before any work
    if index_folder is not None:
        check_index(index_folder)
    results: dict[Member, Description] = {}
    failures: dict[Member, str] = {}
    codes = [0]
    for number, (member, work) in enumerate(batch.run(members, cluster, workers), 1):
        document = _heading(member, with_folders)
        try:
            results[member] = {**document, **work()}
        except Exception as error:
            codes.append(report_failure(error))
            reason = printable_sentence(error)
            failures[member] = reason or type(error).__name__
            results[member] = {**document, "error": reason, "exit_code": codes[-1]}
        progress(number / len(members))
    documents = [results[member] for member in members]
    rows = [summary(results[member]) for member in members if member.changes]
    if len(failures) == len(members):  # leaves nothing behind
        sweep_folder = index_folder = None
    folder = (sweep_folder if rows else None) or index_folder
    with nullcontext() if folder is None or not (rows or folder.is_dir()) else occupied(folder):
        sections = _sweep_sections(rows, sweep_folder, figures) if rows else []
        if index_folder is not None:
            try:
                cached_index(index_folder, {member.folder: failures.get(member, "") for member in members})
            except Exception as error:
                codes.append(report_failure(error))
    return BatchOutcome(documents, sections, max(codes))


def _heading(member: Member, with_folder: bool) -> dict[str, Any]:
    document: dict[str, Any] = {"scene": str(member.scene)}
    if member.changes:
        document |= {"folder": str(member.folder)} if with_folder else {}
        document["values"] = member.values
    return document


def _sweep_sections(rows: list[SweepRow], folder: Path | None, figures: FigureFiles) -> list[Section]:
    if folder is None:
        return [("Sweep", lines(rows))]
    write_sweep(folder, rows, figures)
    return [(f"Sweep: {folder / 'sweep.csv'}", lines(rows))]
