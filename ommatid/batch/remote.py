"""Scenes sent to other machines: the data that a worker needs, and the files that it sends back.

The machines share no files. The worker starts with a copy of the scene's folder, so that results that are up to date
are not made again, and returns new and changed files.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.execution.cluster import scratch_folder
from ommatid.runtime.files import write_whole
from ommatid.runtime.printable import printable
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import command, command_line
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup

WORLD = "world"  # folder inside that of the scene, on a worker
LAST = "run.json"  # is written last, since it vouches for the other files


@dataclass(frozen=True)
class RunObserver:
    """Callbacks of a run: `progress` yields a context for a stage; `done` takes a stage and True if it was executed.

    start_up : returns the seconds since the process started; None where it runs other scenes, too
    """

    progress: Callable[[str], AbstractContextManager[Progress]]
    done: Callable[[str, bool], None]
    start_up: Callable[[], float] | None = None


SILENT = RunObserver(lambda _: nullcontext(no_progress), lambda _stage, _made: None)
Stages = Callable[[Setup, Path, RunObserver], dict[str, Any]]


@dataclass(frozen=True)
class ScenePackage:
    """Everything that a worker needs for a scene.

    tables, source : the scene, and its file for messages;  image : on the target, (rows, columns)
    folder, files : the scene's folder for messages, and its content;  command : words of the command line
    world : content of the files of its [world] by their paths inside `world_root`, `world_file` that of the world's own
    """

    tables: dict[str, Any]
    source: str
    image: FloatArray
    folder: str
    files: dict[str, bytes]
    command: tuple[str, ...] = ()
    world: dict[str, bytes] = field(default_factory=dict[str, bytes])
    world_root: str = ""
    world_file: str = ""


@dataclass(frozen=True)
class SceneOutcome:
    """New and changed files, the stages with True if they were executed, and a description or an error.

    removed : names of files that the stages removed
    """

    files: dict[str, bytes] = field(default_factory=dict[str, bytes])
    done: dict[str, bool] = field(default_factory=dict[str, bool])
    description: dict[str, Any] = field(default_factory=dict[str, Any])
    error: Exception | None = None
    removed: tuple[str, ...] = ()


def packed(setup: Setup, folder: Path) -> ScenePackage:
    """Pack a scene, the content of its folder, and its world. Raises InputError."""
    tables, source = setup.resolved.plain(), str(setup.scene.source)
    package = ScenePackage(tables, source, setup.picture, str(folder), _contents(folder), command())
    return package if setup.scene.world is None else _with_world(package, setup.scene)


def carry_out(stages: Stages, package: ScenePackage | SceneOutcome) -> SceneOutcome:
    """Execute `stages` in a temporary folder; a failure keeps the files made before it.

    package : an outcome, of a scene that could not be packed, is returned as it is
    """
    if isinstance(package, SceneOutcome):
        return package
    with TemporaryDirectory(prefix="ommatid-", dir=scratch_folder()) as temporary:
        folder = Path(temporary)
        write_inside(folder, package.files)
        world = path_inside(folder / WORLD, package.world_file) if package.world_file else None

        def work(observer: RunObserver) -> dict[str, Any]:
            write_inside(folder / WORLD, package.world)
            scene = parse(package.tables, Path(package.source), world)
            return stages(Setup(scene, derive(scene), package.image), folder, observer)

        with command_line(package.command):
            outcome = outcome_of(work)
        error = outcome.error
        if isinstance(error, InputError | MachineError):
            message = "".join(map(str, error.args[:1]))  # as raised: names of folders are replaced in whole
            if world is not None:
                message = message.replace(str(folder / WORLD), package.world_root)
            error = type(error)(message.replace(temporary, package.folder))
        contents = _contents(folder)
        files = {name: content for name, content in contents.items() if package.files.get(name) != content}
        return replace(outcome, files=files, error=error, removed=tuple(package.files.keys() - contents.keys()))


def outcome_of(work: Callable[[RunObserver], dict[str, Any]], observer: RunObserver | None = None) -> SceneOutcome:
    """Execute `work`; return its results or its error, and its finished stages unless an `observer` is told of them."""
    done: dict[str, bool] = {}
    collecting = RunObserver(lambda _: nullcontext(no_progress), done.__setitem__)
    try:
        return SceneOutcome({}, done, work(observer or collecting))
    except (InputError, MachineError, OSError, MemoryError) as error:
        return SceneOutcome({}, done, error=error)


def unpack(outcome: SceneOutcome, folder: Path) -> None:
    """Remove the removed files and write the returned ones, run.json last. Raises InputError or MachineError.

    A name that leads out of the folder is refused before anything is written.
    """
    paths = {name: path_inside(folder, name) for name in (*outcome.removed, *outcome.files)}
    for name in outcome.removed:
        paths[name].unlink(missing_ok=True)
    for name in sorted(outcome.files, key=LAST.__eq__):
        write_whole(paths[name], partial(_write_bytes, outcome.files[name]))


def _write_bytes(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _contents(folder: Path) -> dict[str, bytes]:
    """Read the files of a folder by name, in alphabetical order, the last one written at the end.

    Hidden files and links are left out; a link may lead to a file that is not to be sent to other machines. A folder
    that does not exist has none.
    """
    if not folder.is_dir():
        return {}
    regular = [path for path in folder.iterdir() if path.is_file() and not path.is_symlink()]
    files = [path for path in regular if not path.name.startswith(".")]
    return {path.name: path.read_bytes() for path in sorted(files, key=lambda path: (path.name == LAST, path.name))}


def _with_world(package: ScenePackage, scene: Scene) -> ScenePackage:
    """Pack the world of a scene. Raises InputError for a file that it names by an absolute path."""
    from ommatid.simulate.renderer.world import files, path_of

    paths = [Path(os.path.normpath(path)) for path in files(scene)]
    root = Path(os.path.commonpath([path.parent for path in paths]))
    contents = {str(path.relative_to(root)): path.read_bytes() for path in paths}
    named = b"".join(content for name, content in contents.items() if name.endswith(".xml"))
    for path in paths:
        if str(path).encode() in named:
            raise InputError(
                f"{scene.source}: world.file: names {path}, which other machines may not have;"
                " name it relative to the world's file, or leave out --scheduler"
            )
    own = Path(os.path.normpath(path_of(scene))).relative_to(root)
    return replace(package, world=contents, world_root=str(root), world_file=str(own))


def write_inside(folder: Path, contents: dict[str, bytes]) -> None:
    """Write files into a folder, by their names. Raises InputError, before anything, if one leads out of the folder."""
    paths = {name: path_inside(folder, name) for name in contents}
    for name, content in contents.items():
        paths[name].parent.mkdir(parents=True, exist_ok=True)
        paths[name].write_bytes(content)


def path_inside(folder: Path, name: str) -> Path:
    """Return the path of a file that another machine names, inside a folder. Raises InputError if it leads out."""
    parts = PurePath(name).parts
    if not parts or ".." in parts or PurePath(name).is_absolute():
        raise InputError(
            f"{folder}: another machine sent a file '{printable(name)}', expected one inside this folder; nothing was"
            " written, check the cluster"
        )
    return folder / name
