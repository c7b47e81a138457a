"""The files of a world, sent to another machine with its scene."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PurePath

from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable
from ommatid.scenes.scene import Scene


@dataclass(frozen=True)
class WorldPackage:
    """A world's file and those that it names.

    root : the folder that holds all of them;  file : the world's, relative to it
    contents : of the files, by their paths relative to `root`
    """

    root: str
    file: str
    contents: dict[str, bytes]


def packed_world(scene: Scene) -> WorldPackage:
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
    return WorldPackage(str(root), str(Path(os.path.normpath(path_of(scene))).relative_to(root)), contents)


def unpacked_world(package: WorldPackage, folder: Path) -> Path:
    """Write the files of a world into a folder, and return the path of the world's own.

    Raises InputError before anything is written if a name leads out of the folder.
    """
    world, paths = path_inside(folder, package.file), {name: path_inside(folder, name) for name in package.contents}
    for name, content in package.contents.items():
        path = paths[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return world


def path_inside(folder: Path, name: str) -> Path:
    """Return the path of a file that another machine names, inside a folder. Raises InputError if it leads out."""
    parts = PurePath(name).parts
    if not parts or ".." in parts or PurePath(name).is_absolute():
        raise InputError(
            f"{folder}: another machine sent a file '{printable(name)}', expected one inside this folder; nothing was"
            " written, check the cluster"
        )
    return folder / name
