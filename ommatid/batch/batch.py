"""Many scenes, side by side in processes or on a cluster, each independent of what becomes of the others.

Numbers do not depend on where a scene is done, nor beside which others.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.files import check_output, clear_abandoned, make_folder
from ommatid.runtime.pool import check_options, worker_pool
from ommatid.runtime.processors import processors
from ommatid.runtime.workers import Completed
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.scene import TRUTH, Scene, write
from ommatid.scenes.setup import Setup

from .remote import RunObserver, SceneOutcome, ScenePackage, Stages, carry_out, done_of, packed, unpack

Description = dict[str, Any]


@dataclass(frozen=True)
class Member:
    """A scene file of a batch, what is changed in it, and the folder of its results."""

    scene: Path
    folder: Path
    changes: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, str]:
        """What is changed, key by key, as it was written."""
        return {key: value for key, _, value in (change.partition("=") for change in self.changes)}


Works = Generator[tuple[Member, Callable[[], Description]]]


@dataclass(frozen=True)
class Batch:
    """What is asked of every scene.

    opened : reads and checks it;  stages : what is done, and the description of it;  watch : who hears of a folder
    tell : passes on what became of it;  facts : what has to be the same on all machines, given whether the variant is
        left to them;  fitting : how many memory holds side by side
    """

    opened: Callable[[Member], Setup]
    stages: Stages
    watch: Callable[[Path], RunObserver]
    tell: Callable[[Member, Description], Description]
    facts: Callable[[bool], dict[str, str]]
    fitting: Callable[[Sequence[Member]], int]

    def works(self, members: Sequence[Member], scheduler: str = "", count: int | None = None) -> Works:
        """Every scene with what does it or tells why it failed: in `count` processes, or on a cluster.

        Without either, in as many processes as there are scenes, processors and memory for them.
        Where that is one, it is this one, which tells more while it works.
        """
        check_options(scheduler, count)
        if scheduler:
            return self._sent(members, scheduler)
        count = min(self._side_by_side(members) if count is None else count, len(members))
        return self._beside(members, count) if count > 1 else self._here(members)

    def _side_by_side(self, members: Sequence[Member]) -> int:
        most = min(len(members), processors())
        return min(most, self.fitting(members)) if most > 1 else 1

    def _here(self, members: Sequence[Member]) -> Works:
        for member in members:
            yield member, partial(self._work, member)

    def _work(self, member: Member) -> Description:
        description = self.stages(self.opened(member), member.folder, self.watch(member.folder))
        return self.tell(member, description)

    def _beside(self, members: Sequence[Member], count: int) -> Works:
        """Each as it ends; the processes work in the scenes' own folders."""
        with worker_pool(count=count) as pool:
            for ended in pool.each(partial(_in_process, self.opened, self.stages), members):
                member = members[ended.index]
                yield member, partial(self._finished, member, ended)

    def _sent(self, members: Sequence[Member], scheduler: str) -> Works:
        """Each as it ends, what is wrong with it already here first of all."""
        scenes: dict[Member, Scene] = {}
        for member in members:
            try:
                setup = self.opened(member)
                scene = setup.scene
                if scene.world is not None:
                    raise InputError(
                        f"{member.scene}: the files of a [world] do not travel to other machines; leave out --scheduler"
                    )
                prepare(setup, member.folder)
                scenes[member] = scene
            except Exception as error:
                yield member, partial(_raise, error)
        if not scenes:
            return
        with worker_pool(scheduler) as pool:
            left_to_them = any(scene.render.variant == "auto" for scene in scenes.values())
            pool.check_versions(partial(self.facts, left_to_them))
            parcels = _ScenePackages(self, list(scenes))
            try:
                for ended in pool.each(partial(carry_out, self.stages), parcels):
                    member = parcels.sent[ended.index]
                    scenes.pop(member)
                    yield member, partial(self._finished, member, ended)
            except MachineError as error:
                parcels.failed |= {member: MachineError(f"{member.scene}: {error}") for member in scenes}
        for member in scenes:
            yield member, partial(_raise, parcels.failed[member])

    def _finished(self, member: Member, ended: Completed[SceneOutcome]) -> Description:
        """Take in what a worker made of a scene. Raises what stopped it there."""
        try:
            outcome = ended.result()
        except MachineError as error:
            raise MachineError(f"{member.scene}: {error}") from error
        unpack(outcome, member.folder)
        watch = self.watch(member.folder)
        for stage, made in outcome.done.items():
            watch.done(stage, made)
        if outcome.error is not None:
            raise outcome.error
        return self.tell(member, outcome.description)


def _in_process(opened: Callable[[Member], Setup], stages: Stages, member: Member) -> SceneOutcome:
    """What becomes of a scene in a process on this machine, which finds the scene's files and writes its folder."""
    return done_of(lambda watch: stages(opened(member), member.folder, watch))


class _ScenePackages:
    """The scenes of a batch, opened again one by one as workers are free: the pictures of all might be too many."""

    def __init__(self, batch: Batch, members: list[Member]) -> None:
        self.sent: list[Member] = []
        self.failed: dict[Member, Exception] = {}
        self._batch = batch
        self._members = members

    def __iter__(self) -> Iterator[ScenePackage]:
        for member in self._members:
            try:
                parcel = packed(self._batch.opened(member), member.folder)
            except Exception as error:  # removed meanwhile
                self.failed[member] = error
                continue
            self.sent.append(member)
            yield parcel


def prepare(setup: Setup, folder: Path) -> None:
    """Make the folder of a scene, with the scene and its target in it. Raises InputError or DeniedError.

    What a world truly looks like is rendered later.
    """
    scene = setup.scene
    make_folder(folder)
    clear_abandoned(folder)
    for name in ("scene.toml", TRUTH):
        check_output(folder / name, scene.source, *([Path(scene.target.image)] if scene.target.image else []))
    write(folder / "scene.toml", setup.resolved)
    if scene.world is None:
        write_truth(folder / TRUTH, setup.image)


def _raise(error: Exception) -> Description:
    raise error
