"""Many scenes, one after the other here or side by side on workers, each independent of what becomes of the others."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from .camera import Camera
from .errors import DeniedError, InputError
from .files import make_folder, refuse_output
from .parcel import Outcome, Parcel, Stages, Watch, carry_out, packed, unpack
from .picture import Image, write_truth
from .scene import TRUTH, Scene, resolved, write
from .workers import Ended, refuse_options, workers

Description = dict[str, Any]
Works = Generator[tuple[Path, Callable[[], Description]]]


@dataclass(frozen=True)
class Batch:
    """What is asked of every scene.

    opened : reads and checks it;  stages : what is done, and the description of it;  watch : who hears of a folder
    tell : passes on what became of it;  facts : what has to be the same on all machines, given whether the variant is
        left to them
    """

    opened: Callable[[Path], tuple[Scene, Camera, Image]]
    stages: Stages
    watch: Callable[[Path], Watch]
    tell: Callable[[Scene, Path, Description], Description]
    facts: Callable[[bool], dict[str, str]]

    def works(self, folders: dict[Path, Path], scheduler: str = "", count: int | None = None) -> Works:
        """Every scene with what does it or tells why it failed, here or on workers; `folders` are its results'."""
        return self._sent(folders, scheduler, count) if scheduler or count else self._here(folders)

    def _here(self, folders: dict[Path, Path]) -> Works:
        for path, folder in folders.items():
            yield path, partial(self._work, path, folder)

    def _work(self, path: Path, folder: Path) -> Description:
        scene, camera, image = self.opened(path)
        return self.tell(scene, folder, self.stages(scene, camera, image, folder, self.watch(folder)))

    def _sent(self, folders: dict[Path, Path], scheduler: str, count: int | None) -> Works:
        """Each as it ends, what is wrong with it already here first of all."""
        refuse_options(scheduler, count)
        scenes: dict[Path, Scene] = {}
        for path, folder in folders.items():
            try:
                scene, _, image = self.opened(path)
                if scheduler and scene.world is not None:
                    raise InputError(
                        f"{path}: the files of a [world] do not travel to other machines; leave out --scheduler"
                    )
                prepare(scene, image, folder)
                scenes[path] = scene
            except Exception as error:
                yield path, partial(_raise, error)
        if not scenes:
            return
        with workers(scheduler, count and min(count, len(scenes))) as pool:
            left_to_them = any(scene.render.variant == "auto" for scene in scenes.values())
            pool.refuse_differences(partial(self.facts, left_to_them))
            parcels = _Parcels(self, [(path, folders[path]) for path in scenes])
            try:
                for ended in pool.each(partial(carry_out, self.stages), parcels):
                    path = parcels.sent[ended.place]
                    yield path, partial(self._finished, path, scenes.pop(path), folders[path], ended)
            except DeniedError as error:
                parcels.failed |= {path: DeniedError(f"{path}: {error}") for path in scenes}
        for path in scenes:
            yield path, partial(_raise, parcels.failed[path])

    def _finished(self, path: Path, scene: Scene, folder: Path, ended: Ended[Outcome]) -> Description:
        """Take in what a worker made of a scene. Raises what stopped it there."""
        try:
            outcome = ended.result()
        except DeniedError as error:
            raise DeniedError(f"{path}: {error}") from error
        unpack(outcome, folder)
        watch = self.watch(folder)
        for stage, made in outcome.done.items():
            watch.done(stage, made)
        if outcome.error is not None:
            raise outcome.error
        return self.tell(scene, folder, outcome.description)


class _Parcels:
    """The scenes of a batch, opened again one by one as workers are free: the pictures of all might be too many."""

    def __init__(self, batch: Batch, places: list[tuple[Path, Path]]) -> None:
        self.sent: list[Path] = []
        self.failed: dict[Path, Exception] = {}
        self._batch = batch
        self._places = places

    def __iter__(self) -> Iterator[Parcel]:
        for path, folder in self._places:
            try:
                parcel = packed(*self._batch.opened(path), folder)
            except Exception as error:  # removed meanwhile
                self.failed[path] = error
                continue
            self.sent.append(path)
            yield parcel


def prepare(scene: Scene, image: Image, folder: Path) -> None:
    """Make the folder of a scene, with the scene and its target in it. Raises InputError or DeniedError.

    What a world truly looks like is rendered later.
    """
    make_folder(folder)
    for name in ("scene.toml", TRUTH):
        refuse_output(folder / name, scene.source, *([Path(scene.target.image)] if scene.target.image else []))
    rows, columns = image.shape
    write(folder / "scene.toml", resolved(scene, (rows, columns)))
    if scene.world is None:
        write_truth(folder / TRUTH, image)


def _raise(error: Exception) -> Description:
    raise error
