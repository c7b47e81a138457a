"""The files of a result: none of an earlier result stays beside a new one, and no other file is touched."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import tifffile

from ommatid.analysis import study
from ommatid.batch.remote import RunObserver, carry_out, packed, unpack
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup

from ..conftest import TINY, Command

RUN = ("run", "tiny.toml", "-o", "out", "-q")
CHANGED = ("--set", "prior.mean=100")
FORMATS = {"estimate.npy", "estimate.tiff"}
STUDY = {study.NUMBERS, study.TABLE}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_study(folder: Path) -> None:
    for name in STUDY:
        (folder / name).write_text("of an earlier run", encoding="utf-8")


# --- a new result


def test_a_new_result_removes_the_formats_and_the_study_of_the_old_one(kept: Path, ommatid: Command) -> None:
    assert ommatid(*RUN, "--format", "npy,tiff16").code == 0
    write_study(kept)
    assert names(kept) >= FORMATS
    assert ommatid(*RUN).code == 0
    assert names(kept) >= FORMATS, "the result is up to date, and so are they"
    assert not names(kept) & STUDY
    write_study(kept)
    assert ommatid(*RUN, *CHANGED).code == 0
    assert not names(kept) & (FORMATS | STUDY)


def test_a_reconstruction_removes_what_an_earlier_run_left_in_its_folder(
    kept: Path, finished: Path, ommatid: Command
) -> None:
    command = "reconstruct", finished / "stack.exr", finished / "model.npz", "-o", kept, "-q"
    for name in FORMATS | STUDY:
        (kept / name).write_text("of an earlier run", encoding="utf-8")
    assert ommatid(*command, *CHANGED).code == 0
    assert not names(kept) & (FORMATS | STUDY | {"scene.toml"})
    (kept / "scene.toml").write_text(TINY, encoding="utf-8")
    assert ommatid(*command).code == 0
    assert (kept / "scene.toml").read_text(encoding="utf-8") == TINY, "a scene that no run wrote stays"


def test_a_reconstruction_keeps_the_scene_of_its_stack(kept: Path, finished: Path, ommatid: Command) -> None:
    before = (kept / "scene.toml").read_bytes()
    assert ommatid("reconstruct", finished / "stack.exr", finished / "model.npz", "-o", kept, "-q").code == 0
    assert (kept / "scene.toml").read_bytes() == before


def test_a_new_estimate_alone_removes_its_old_formats(finished: Path, here: Path, ommatid: Command) -> None:
    command = "reconstruct", finished / "stack.exr", finished / "model.npz", "-o", "a.exr", "-q"
    assert ommatid(*command, "--format", "npy,tiff16").code == 0
    assert ommatid(*command, *CHANGED).code == 0
    assert names(here) == {"tiny.toml", "a.exr", "a.png"}
    np.save("a.npy", np.zeros((2, 2)))
    tifffile.imwrite("a.tiff", np.zeros((2, 2)))
    before = content(here)
    assert ommatid(*command, *CHANGED).code == 0
    others = [str(here / name) for name in ("a.npy", "a.tiff")]
    assert [content(here)[name] for name in others] == [before[name] for name in others], "they show something else"


def test_one_of_many_frames_removes_its_old_formats(finished: Path, here: Path, ommatid: Command) -> None:
    stacks = [shutil.copy(finished / "stack.exr", here / f"{name}.exr") for name in "ab"]
    command = "reconstruct", *stacks, finished / "model.npz", "-o", "film", "-q"
    assert ommatid(*command, "--format", "npy,tiff16").code == 0
    assert ommatid(*command, *CHANGED).code == 0
    assert names(here / "film") == {"a.exr", "a.png", "b.exr", "b.png"}


def _removes_the_stack(setup: Setup, folder: Path, observer: RunObserver) -> dict[str, str]:
    del setup, observer
    (folder / "stack.exr").unlink()
    return {}


def test_what_a_worker_removes_is_removed_here(kept: Path, here: Path) -> None:
    before = names(kept)
    unpack(carry_out(_removes_the_stack, packed(Setup.from_scene(read(here / "tiny.toml")), kept)), kept)
    assert names(kept) == before - {"stack.exr"}
