"""Batches of scenes as the commands ask for them, with the tables and pages that describe a whole batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ommatid.batch import sweep
from ommatid.batch.batch import Batch, Description, Member
from ommatid.batch.remote import RunObserver, Stages
from ommatid.batch.sweep_row import summary
from ommatid.batch.sweep_table import lines, write_sweep
from ommatid.page.batch_index import cached_index
from ommatid.runtime.errors import InputError
from ommatid.scenes.formats import picture
from ommatid.scenes.scene import read

from .sections import Section
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

    Raises InputError for a sweep that cannot be read, a key that no scene has, and two scenes of one name.
    """
    axes = sweep.sweep_axes(sweeps or ())
    for scene in scenes:
        sweep.check_keys(scene, axes, changes, lenses)
    return sweep.members(scenes, axes, folder)


def batch_warnings(members: Sequence[Member], changes: Sequence[str], lenses: Sequence[str]) -> list[str]:
    """Return what is lost when the pictures of the scenes are read, a sentence each.

    Scenes with errors have none; their errors are reported when they are run.
    """
    of_picture: dict[str | None, list[str]] = {}  # each is read once
    for member in members:
        with suppress(InputError):
            scene = read(member.scene, (*changes, *member.changes), lenses)
            if scene.target.image not in of_picture:
                of_picture[scene.target.image] = picture.conversions(scene)
    return [sentence for sentences in of_picture.values() for sentence in sentences]


def scene_batch(
    changes: Sequence[str],
    lenses: Sequence[str],
    stages: Stages,
    observe: Callable[[Path], RunObserver],
    report: Callable[[Member, Description], Description],
) -> Batch:
    """Create the batch that does `stages` with every scene after `changes`, and passes each result to `report`."""
    options = tuple(changes), tuple(lenses)
    open_scene, count = partial(open_member, *options), partial(process_count, *options)
    return Batch(open_scene, stages, observe, report, library_versions, count)


def run_batch(
    batch: Batch,
    members: Sequence[Member],
    report_failure: Callable[[Exception], int],
    scheduler: str = "",
    workers: int | None = None,
    *,
    sweep_folder: Path | None = None,
    index_folder: Path | None = None,
    with_folders: bool = True,
) -> BatchOutcome:
    """Run every scene of a batch, even if others fail.

    report_failure : returns the exit code of an exception;  with_folders : documents of a sweep name the folders
    sweep_folder, index_folder : where the table of a sweep and the page of the batch are written, if anywhere
    """
    results: dict[Member, Description] = {}
    failures: dict[Member, str] = {}
    codes = [0]
    for member, work in batch.run(members, scheduler, workers):
        document = _heading(member, with_folders)
        try:
            results[member] = {**document, **work()}
        except Exception as error:
            codes.append(report_failure(error))
            failures[member] = str(error) or type(error).__name__
            results[member] = {**document, "error": str(error), "exit_code": codes[-1]}
    documents = [results[member] for member in members]
    sections = _sweep_sections(documents, sweep_folder) if members[0].changes else []
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


def _sweep_sections(documents: list[Description], folder: Path | None) -> list[Section]:
    rows = [summary(document) for document in documents]
    if folder is None:
        return [("Sweep", lines(rows))]
    write_sweep(folder, rows)
    return [(f"Sweep: {folder / 'sweep.csv'}", lines(rows))]
