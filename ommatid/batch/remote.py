"""A scene on its way to another machine: all that is needed to work on it there, and what comes back.

The machines share no files. The worker finds in a folder of its own what already stands in the scene's folder here,
so that what is up to date is not done again, and sends back what is new or has changed.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ommatid.runtime.dask_cluster import scratch_folder
from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.files import write_whole
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import Image
from ommatid.scenes.scene import parse
from ommatid.scenes.setup import Setup

LAST = "run.json"  # stands for all the others


@dataclass(frozen=True)
class RunObserver:
    """Who hears how the work goes on: a context a stage for its progress, and whether the stage had to be done."""

    progress: Callable[[str], AbstractContextManager[Progress]]
    done: Callable[[str, bool], None]


Stages = Callable[[Setup, Path, RunObserver], dict[str, Any]]


@dataclass(frozen=True)
class ScenePackage:
    """A scene as tables, the file that its errors name, its target, and its folder: the name, and what is in it."""

    tables: dict[str, Any]
    source: str
    image: Image
    folder: str
    files: dict[str, bytes]


@dataclass(frozen=True)
class SceneOutcome:
    """What comes back: files, the stages that were done or not needed, and a description or why there is none."""

    files: dict[str, bytes]
    done: dict[str, bool]
    description: dict[str, Any]
    error: Exception | None = None


def packed(setup: Setup, folder: Path) -> ScenePackage:
    """A scene and what stands in its folder."""
    return ScenePackage(setup.resolved.plain(), str(setup.scene.source), setup.image, str(folder), _contents(folder))


def carry_out(stages: Stages, parcel: ScenePackage) -> SceneOutcome:
    """Do the stages in a folder that is removed afterwards; what fails does not lose the files made before."""
    with TemporaryDirectory(prefix="ommatid-", dir=scratch_folder()) as temporary:
        folder = Path(temporary)
        for name, content in parcel.files.items():
            (folder / name).write_bytes(content)

        def work(watch: RunObserver) -> dict[str, Any]:
            scene = parse(parcel.tables, Path(parcel.source))
            return stages(Setup(scene, derive(scene), parcel.image), folder, watch)

        outcome, failure = done_of(work), None
        if isinstance(outcome.error, InputError | MachineError):
            failure = type(outcome.error)(str(outcome.error).replace(temporary, parcel.folder))
        files = {name: content for name, content in _contents(folder).items() if parcel.files.get(name) != content}
        return replace(outcome, files=files, error=failure or outcome.error)


def done_of(work: Callable[[RunObserver], dict[str, Any]]) -> SceneOutcome:
    """What some stages did before they ended or failed, without files."""
    done: dict[str, bool] = {}
    try:
        return SceneOutcome({}, done, work(RunObserver(lambda _: nullcontext(no_progress), done.__setitem__)))
    except (InputError, MachineError, OSError, MemoryError) as error:
        return SceneOutcome({}, done, {}, error)


def unpack(outcome: SceneOutcome, folder: Path) -> None:
    """Write the files that came back, each whole and run.json last. Raises InputError or DeniedError."""
    for name in sorted(outcome.files, key=LAST.__eq__):
        write_whole(folder / name, lambda beside, name=name: _fill(beside, outcome.files[name]))


def _contents(folder: Path) -> dict[str, bytes]:
    """The files in a folder by name, in the order in which they were written; hidden ones are none of ours."""
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    return {path.name: path.read_bytes() for path in sorted(files, key=lambda path: path.stat().st_mtime_ns)}


def _fill(path: Path, content: bytes) -> None:
    path.write_bytes(content)
