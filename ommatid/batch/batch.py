"""Batches of scenes, in this process, in several, or on a cluster; failures of scenes are independent.

The numbers do not depend on where a scene is run, nor on the scenes beside it. A scene's folder is checked and prepared
before its stages, which can be wrapped: to make everything again, and to write the estimate in more formats.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from ommatid.reconstruct.output.estimate_formats import Format, write_formats
from ommatid.runtime.errors import InputError, MachineError, NotStartedError
from ommatid.runtime.execution.cluster import Cluster
from ommatid.runtime.execution.pool import check_options, worker_pool
from ommatid.runtime.execution.workers import Completed
from ommatid.runtime.files import clear_abandoned, make_folder
from ommatid.runtime.input_files import real_path
from ommatid.runtime.machine import processors
from ommatid.runtime.outputs.kinds import check_folder, check_inside, check_output
from ommatid.runtime.outputs.occupied import new_folder, occupied
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.scene import TRUTH, WORLD_PICTURE, Scene, read, write
from ommatid.scenes.setup import Setup

from .remote import RunObserver, SceneOutcome, ScenePackage, Stages, carry_out, outcome_of, packed, unpack

Description = dict[str, Any]

# What a run writes that could be the picture of its target.
PICTURES = (
    *("stack.exr", "estimate.exr", "estimate.png", "estimate.npy", "estimate.tiff", "overview.png", "depth.png"),
    *("scene.toml", TRUTH),
)
OTHERS = "model.npz", "run.json", "report.html"

# What the stages write; the calibrated models of a study and interrupted work are beside them.
ESTIMATES = ("estimate.exr", "estimate.npy", "estimate.tiff")
RENDERED = "stack.exr"
RESULTS = (RENDERED, "model*.npz", "run.json", *ESTIMATES, "study.json", "report.html", ".*.partial.npz")

Check = Callable[[Setup, Path], None]  # raises InputError where the stages would, and writes nothing


@dataclass(frozen=True)
class Member:
    """A scene file of a batch, and the folder of its results.

    changes : KEY=VALUE of a sweep, after those `common` to all scenes;  lenses : that are kept, none for all
    """

    scene: Path
    folder: Path
    changes: tuple[str, ...] = ()
    common: tuple[str, ...] = ()
    lenses: tuple[str, ...] = ()

    @cached_property
    def content(self) -> Scene:
        """Read and check the scene, once. Raises InputError."""
        return read(self.scene, (*self.common, *self.changes), self.lenses)

    @property
    def values(self) -> dict[str, str]:
        """The changed values by key, as they were written."""
        return {key: value for key, _, value in (change.partition("=") for change in self.changes)}


# Each scene with a function that runs it, or collects its results, and returns the description or raises the error.
Runs = Generator[tuple[Member, Callable[[], Description]]]


@dataclass(frozen=True)
class Batch:
    """The functions that run the scenes of a batch.

    open : reads and checks a scene
    stages : runs it and returns its description
    observe : creates the observer for a folder
    report : reports a description to the user, and returns it
    versions : versions that have to agree on all machines; True as argument adds the variant that `auto` selects
    count : number of scenes that are best run at once
    """

    open: Callable[[Member], Setup]
    stages: Stages
    observe: Callable[[Path], RunObserver]
    report: Callable[[Member, Description], Description]
    versions: Callable[[bool], dict[str, str]]
    count: Callable[[Sequence[Member]], int]

    def run(self, members: Sequence[Member], cluster: Cluster | None = None, count: int | None = None) -> Runs:
        """Yield every scene with a function that returns its description or raises its error.

        Scenes run in `count` processes or on `cluster`; without either, in as many processes as
        finish soonest, given the scenes, processors and memory. A single process is this one, which shows progress.
        """
        check_options(cluster, count)
        if cluster is not None:
            return self._on_cluster(members, cluster)
        count = min(self._best_count(members) if count is None else count, len(members))
        return self._in_processes(members, count) if count > 1 else self._in_this_process(members)

    def _best_count(self, members: Sequence[Member]) -> int:
        most = min(len(members), processors())
        return min(most, self.count(members)) if most > 1 else 1

    def _in_this_process(self, members: Sequence[Member]) -> Runs:
        for member in members:
            yield member, partial(self._run_here, member)

    def _run_here(self, member: Member) -> Description:
        description = self.stages(self.open(member), member.folder, self.observe(member.folder))
        return self.report(member, description)

    def _in_processes(self, members: Sequence[Member], count: int) -> Runs:
        """Yield scenes as they end; the processes write to the scenes' own folders."""
        with worker_pool(count=count) as pool:
            ended = pool.each(partial(_run_in_process, self.open, self.stages), members)
            yield from self._collected(ended, members)

    def _on_cluster(self, members: Sequence[Member], cluster: Cluster) -> Runs:
        """Yield scenes with errors that show already here, then the others as they end."""
        waiting: list[Member] = []
        auto_variant = False
        for member in members:
            try:
                setup = self.open(member)
                check_files(setup, member.folder)
                with new_folder(member.folder):  # fails before any work if there can be none
                    waiting.append(member)
            except Exception as error:
                yield member, partial(_raise, error)
                continue
            auto_variant |= setup.scene.render.variant == "auto"
        if not waiting:
            return
        with worker_pool(cluster) as pool:
            pool.check_versions(partial(self.versions, auto_variant))
            packages = map(self._packed, waiting)  # as workers become free: all images might not fit into memory
            yield from self._collected(pool.each(partial(carry_out, self.stages), packages), waiting)

    def _packed(self, member: Member) -> ScenePackage | SceneOutcome:
        """Return the package of a scene, or why there is none."""
        try:
            return packed(self.open(member), member.folder)
        except Exception as error:  # a file was removed since it was checked
            return SceneOutcome({}, {}, {}, error)

    def _collected(self, tasks: Iterable[Completed[SceneOutcome]], members: Sequence[Member]) -> Runs:
        """Yield the scenes of tasks as they end, then those left over if connection or processes are lost."""
        waiting = dict.fromkeys(range(len(members)))
        failed: dict[Member, Exception] = {}
        try:
            for ended in tasks:
                if ended.loss is not None:
                    raise ended.loss
                del waiting[ended.index]
                yield members[ended.index], partial(self._collect, members[ended.index], ended)
        except MachineError as error:
            failed = _unfinished([members[index] for index in waiting], error)
        for member, error in failed.items():
            yield member, partial(_raise, error)

    def _collect(self, member: Member, ended: Completed[SceneOutcome]) -> Description:
        """Write the files that a worker returned, and report its stages. Raises the worker's error.

        A scene that was refused leaves no files.
        """
        try:
            outcome = ended.result()
        except MachineError as error:
            raise MachineError(f"{member.scene}: {error}") from error
        if outcome.done or not isinstance(outcome.error, InputError):
            with occupied(member.folder):
                unpack(outcome, member.folder)
        observer = self.observe(member.folder)
        for stage, executed in outcome.done.items():
            observer.done(stage, executed)
        if outcome.error is not None:
            raise outcome.error
        return self.report(member, outcome.description)


def _unfinished(members: Sequence[Member], error: MachineError) -> dict[Member, Exception]:
    """Return an error for each scene that is left when a cluster or a process fails; the first counts the others."""
    if not members:
        return {}
    first, *others = members
    count = f" and {len(others)} more" if others else ""
    failures: dict[Member, Exception] = {first: MachineError(f"{first.scene}{count}: {error}")}
    return failures | {member: NotStartedError(f"{member.scene}: {error}") for member in others}


def _run_in_process(open_member: Callable[[Member], Setup], stages: Stages, member: Member) -> SceneOutcome:
    """Run a scene in another process of this machine, which reads its files and writes to its folder."""
    return outcome_of(lambda observer: stages(open_member(member), member.folder, observer))


def check_files(setup: Setup, folder: Path) -> None:
    """Raise InputError if a scene has no picture, or if its results would replace a file that it is read from."""
    scene, _ = setup.scene, setup.picture
    check_folder(folder)
    check_inside(folder)
    if folder.is_dir():
        read = scene.source, *([Path(scene.target.image)] if scene.target.image else [])
        for name in (*PICTURES, *OTHERS, *([WORLD_PICTURE] if setup.camera.detail > 1 else [])):
            check_output(folder / name, *read)


def prepare(setup: Setup, folder: Path) -> None:
    """Make the folder of a scene and write the scene and its target image. Raises InputError or MachineError.

    The true image of a world is rendered later.
    """
    check_files(setup, folder)  # first, since a scene without a picture leaves no folder behind
    make_folder(folder)
    clear_abandoned(folder)
    write(folder / "scene.toml", setup.resolved)
    if setup.scene.world is None:
        write_truth(folder / TRUTH, setup.image)
        if setup.camera.detail > 1:
            write_truth(folder / WORLD_PICTURE, setup.picture)


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


def _raise(error: Exception) -> Description:
    raise error
