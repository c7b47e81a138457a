"""Batches of scenes, in this process, in several, or on a cluster, with the table and the page of the whole batch.

Failures of scenes are independent. The numbers do not depend on where a scene is run, nor on the scenes beside it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ommatid.batch import sweep
from ommatid.batch.batch import Description, Member, check_files
from ommatid.batch.remote import RunObserver, SceneOutcome, ScenePackage, Stages, carry_out, outcome_of, packed, unpack
from ommatid.batch.sweep_row import summary
from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.runtime.errors import InputError, MachineError, NotStartedError
from ommatid.runtime.execution.cluster import Cluster, worker_pool
from ommatid.runtime.outputs.kinds import check_folder
from ommatid.runtime.outputs.occupied import new_folder, occupied
from ommatid.runtime.printable import printable_sentence
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.formats import picture

from .stages import library_versions, open_member

if TYPE_CHECKING:
    from ommatid.analysis.summary import Section

# Each scene with a function that returns its outcome, or raises its error.
Runs = Generator[tuple[Member, Callable[[], SceneOutcome]]]
Facts = Callable[[], dict[str, str]]


@dataclass
class BatchOutcome:
    """The results of a batch: a JSON document per scene, the table of a sweep, and the worst exit code."""

    documents: list[Description] = field(default_factory=list[Description])
    sections: list[Section] = field(default_factory=list["Section"])
    exit_code: int = 0


@dataclass(frozen=True)
class BatchFiles:
    """Where the table of a sweep and the page of the batch are written, if anywhere; figures : files of the figure."""

    sweep: Path | None = None
    index: Path | None = None
    figures: FigureFiles = SCREEN_PNG

    def check(self) -> None:
        """Raise InputError before any work if they could not be written, or would replace other files."""
        for folder in (self.index, self.sweep):
            if folder is not None:
                check_folder(folder)
        if self.index is not None and (page := self.index / "index.html").is_file():
            from ommatid.page.cached import check_own_page

            check_own_page(page)


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


@dataclass(frozen=True)
class Batch:
    """The work on the scenes of a batch.

    stages : runs a scene and returns its description;  observe : creates the observer for a folder
    report : reports a description to the user, and returns it
    """

    stages: Stages
    observe: Callable[[Path], RunObserver]
    report: Callable[[Member, Description], Description]

    def run(self, members: Sequence[Member], cluster: Cluster | None = None, count: int | None = None) -> Runs:
        """Yield every scene as it ends, with a function that returns its outcome or raises its error.

        Scenes run in `count` processes or on `cluster`; without either, in as many processes as
        finish soonest, given the scenes, processors and memory. A single process is this one, which shows progress.
        If processes or the connection are lost, the first of the scenes that are left says so for all of them.
        """
        requirement = None
        if cluster is None:
            if count is None and len(members) > 1:
                from ommatid.batch.plan import process_count

                count = process_count(members)
            count = min(count or 1, len(members))
            work = partial(_run_member, self.stages, None if count > 1 else self.observe)
            items: Iterable[Any] = members
        else:
            members, failed, requirement = _sendable(members)
            yield from failed
            work = partial(carry_out, self.stages)
            items = map(_packed, members)  # as workers become free: all images might not fit into memory
        if not members:
            return
        waiting = dict(enumerate(members))
        with worker_pool(cluster, count) as pool:
            if requirement is not None:
                pool.check_versions(requirement)
            try:
                for index, outcome in pool.each(work, items):
                    yield waiting.pop(index), outcome
                return
            except MachineError as error:
                loss = error
        first, *others = waiting.values()
        more = f" and {len(others)} more" if others else ""
        yield first, partial(SceneOutcome, error=MachineError(f"{first.scene}{more}: {loss}"))
        for member in others:
            yield member, partial(SceneOutcome, error=NotStartedError(f"{member.scene}: {loss}"))

    def collect(self, member: Member, finished: Callable[[], SceneOutcome]) -> Description:
        """Write the files that a worker returned, and report its stages. Raises the worker's error.

        A scene that was refused leaves no files.
        """
        try:
            outcome = finished()
        except MachineError as error:
            raise MachineError(f"{member.scene}: {error}") from error
        if (outcome.files or outcome.removed) and (outcome.done or not isinstance(outcome.error, InputError)):
            with occupied(member.folder):
                unpack(outcome, member.folder)
        observer = self.observe(member.folder)
        for stage, executed in outcome.done.items():
            observer.done(stage, executed)
        if outcome.error is not None:
            raise outcome.error
        return self.report(member, outcome.description)


def _run_member(stages: Stages, observe: Callable[[Path], RunObserver] | None, member: Member) -> SceneOutcome:
    """Run a scene, which reads its files and writes to its folder; `observe` sees it, None in another process."""
    observer = None if observe is None else observe(member.folder)
    return outcome_of(lambda observer: stages(open_member(member), member.folder, observer), observer)


def _sendable(members: Sequence[Member]) -> tuple[list[Member], list[tuple[Member, Callable[[], SceneOutcome]]], Facts]:
    """Return the scenes that can be sent, those with errors that show already here, and what workers have to agree on.

    A folder that cannot be made is found before any work.
    """
    sendable, failed = list[Member](), list[tuple[Member, Callable[[], SceneOutcome]]]()
    auto_variant = False
    for member in members:
        try:
            setup = open_member(member)
            check_files(setup, member.folder)
            with new_folder(member.folder):
                sendable.append(member)
        except Exception as error:
            failed.append((member, partial(SceneOutcome, error=error)))
            continue
        auto_variant |= setup.scene.render.variant == "auto"
    return sendable, failed, partial(library_versions, auto_variant)


def _packed(member: Member) -> ScenePackage | SceneOutcome:
    """Return the package of a scene, or why there is none."""
    try:
        return packed(open_member(member), member.folder)
    except Exception as error:  # a file was removed since it was checked
        return SceneOutcome(error=error)


def run_batch(
    batch: Batch,
    members: Sequence[Member],
    report_failure: Callable[[Exception], int],
    cluster: Cluster | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
    *,
    files: BatchFiles = BatchFiles(),
    with_folders: bool = True,
) -> BatchOutcome:
    """Run every scene of a batch, even if others fail.

    report_failure : returns the exit code of an exception;  with_folders : documents of a sweep name the folders
    Where all scenes fail, neither table nor page is written.
    """
    files.check()
    results: dict[Member, Description] = {}
    failures: dict[Path, str] = {}
    codes = [0]
    for number, (member, finished) in enumerate(batch.run(members, cluster, workers), 1):
        document = _heading(member, with_folders)
        try:
            results[member] = {**document, **batch.collect(member, finished)}
        except Exception as error:
            codes.append(report_failure(error))
            reason = printable_sentence(error)
            failures[member.folder] = reason or type(error).__name__
            results[member] = {**document, "error": reason, "exit_code": codes[-1]}
        progress(number / len(members))
    if len(failures) == len(members):
        files = BatchFiles()
    outcome = BatchOutcome([results[member] for member in members], exit_code=max(codes))
    _write_files(outcome, members, failures, files, report_failure)
    return outcome


def _write_files(
    outcome: BatchOutcome,
    members: Sequence[Member],
    failures: dict[Path, str],
    files: BatchFiles,
    report_failure: Callable[[Exception], int],
) -> None:
    """Write table and page, and complete `outcome`."""
    pairs = zip(members, outcome.documents, strict=True)
    rows = [summary(document) for member, document in pairs if member.changes]
    folder = (files.sweep if rows else None) or files.index
    with nullcontext() if folder is None or not (rows or folder.is_dir()) else occupied(folder):
        if rows:
            from ommatid.batch.sweep_table import lines, write_sweep

            if files.sweep is not None:
                write_sweep(files.sweep, rows, files.figures)
            title = "Sweep" if files.sweep is None else f"Sweep: {files.sweep / 'sweep.csv'}"
            outcome.sections.append((title, lines(rows)))
        if files.index is not None:
            from ommatid.page.batch_index import cached_index

            try:
                cached_index(files.index, {member.folder: failures.get(member.folder, "") for member in members})
            except Exception as error:
                outcome.exit_code = max(outcome.exit_code, report_failure(error))


def _heading(member: Member, with_folder: bool) -> dict[str, Any]:
    document: dict[str, Any] = {"scene": str(member.scene)}
    if member.changes:
        document |= {"folder": str(member.folder)} if with_folder else {}
        document["values"] = member.values
    return document
