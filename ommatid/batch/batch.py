"""The scenes of a batch, and their folders: checked and prepared before the stages, and emptied to make all again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ommatid.runtime.files import clear_abandoned, make_folder
from ommatid.runtime.input_files import real_path
from ommatid.runtime.outputs.kinds import check_folder, check_inside, check_output
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.scene import TRUTH, WORLD_PICTURE, Scene, read, write
from ommatid.scenes.setup import Setup

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
RESULTS = (RENDERED, "model*.npz", "run.json", *ESTIMATES, "report.html", ".*.partial.npz")


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


def clear_results(folder: Path, setup: Setup) -> None:
    """Remove the results in a folder, so that all stages run again. Folders stay, and files of the scene."""
    scene = setup.scene
    names = RESULTS if scene.world is None else (*RESULTS, TRUTH)
    read = {real_path(scene.source), real_path(Path(scene.target.image or ""))}
    for path in (path for name in names for path in folder.glob(name)):
        if not path.is_dir() and real_path(path) not in read:
            path.unlink()
