"""What commands leave behind: nothing after a refusal or where a link leads, and only regular files are replaced."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from ..conftest import TINY, Command, interpreter
from ..runs import FILES, content

RESULTS = Path("out") / "tiny"
STACK, MODEL = str(RESULTS / "stack.exr"), str(RESULTS / "model.npz")
WORLD = """
<scene version="3.0.0"><shape type="rectangle"/><emitter type="no_such_emitter"/></scene>
"""


def tree(folder: Path) -> dict[str, tuple[int, int]]:
    """Kind and modification time of everything below a folder."""
    return {
        str(path.relative_to(folder)): (path.lstat().st_mode, path.lstat().st_mtime_ns if path.is_file() else 0)
        for path in folder.rglob("*")
    }


def fifo(*names: str) -> Callable[[Path], None]:
    """Make FIFOs, which a command would wait for, in place of files."""

    def make(here: Path) -> None:
        for name in names:
            (here / name).parent.mkdir(parents=True, exist_ok=True)
            (here / name).unlink(missing_ok=True)
            os.mkfifo(here / name)

    return make


def copy(name: str) -> Callable[[Path], None]:
    """Copy the tiny scene under another name."""

    def make(here: Path) -> None:
        shutil.copyfile(here / "tiny.toml", here / name)

    return make


def nothing(here: Path) -> None:
    """Make nothing."""


REFUSED: dict[str, tuple[Callable[[Path], None], str]] = {
    "scene with an unknown key": (nothing, "run tiny.toml -o new/a --set target.nonsense=1"),
    "scene without its picture": (nothing, "run tiny.toml -o new/a --set target.image=none.png"),
    "sweep of predictions": (nothing, "predict tiny.toml --no-rays -o new --sweep target.pixel_pitch=a,b"),
    "two scenes of one name": (nothing, "run tiny.toml tiny.toml -o new"),
    "scene called dot": (copy("..toml"), "run ..toml -o new"),
    "folder inside a scene": (nothing, "run tiny.toml -o tiny.toml/new"),
    "folder that is a FIFO": (fifo("new"), "run tiny.toml -o new"),
    "page that is a FIFO": (fifo("out/tiny/report.html"), "run tiny.toml -o out"),
    "plan beside a FIFO": (fifo("out/tiny/run.json"), "run tiny.toml -o out --dry-run"),
    "new scene that is a FIFO": (fifo("new.toml"), "init new.toml"),
    "lens of a new scene that is a FIFO": (fifo("lenses/achromat.zmx", "lenses/f4.toml"), "init new/new.toml"),
    "regions outside": (nothing, f"reconstruct {STACK} {MODEL} -o new --region 90,90,4,4"),
    "key of the camera": (nothing, f"reconstruct {STACK} {MODEL} -o new/a --set camera.walls=false"),
    "report of no run": (nothing, "report new"),
}


def test_a_refusal_leaves_everything_as_it_was(here: Path, finished: Path, ommatid: Command) -> None:
    for number, (case, (make, command)) in enumerate(REFUSED.items()):
        folder = here / str(number)
        shutil.copytree(finished, folder / "out" / "tiny")
        shutil.copyfile(here / "tiny.toml", folder / "tiny.toml")
        os.chdir(folder)
        make(folder)
        before = tree(folder)
        ended = ommatid(*command.split())
        assert (ended.code, tree(folder)) == (2, before), f"{case}: {ended.err}"
        lines = ended.err.splitlines()
        assert all(len(line) < 450 and line.isprintable() for line in lines), lines
        assert "unexpected" not in ended.err


def test_a_world_that_is_refused_leaves_nothing(here: Path, ommatid: Command) -> None:
    (here / "world.xml").write_text(WORLD, encoding="utf-8")
    text = TINY.replace('image = "photo:camera"\norigin = [100, 230]\n', "") + '\n[world]\nfile = "world.xml"\n'
    (here / "world.toml").write_text(text, encoding="utf-8")
    before = tree(here)
    ended = ommatid("run", "world.toml", "-o", "out/a")
    assert (ended.code, tree(here)) == (2, before), ended.err


@pytest.mark.slow
def test_two_runs_in_one_folder_give_one_result(here: Path, finished: Path) -> None:
    """One of them renders; the other waits, and finds the results."""
    command = [*interpreter(), "run", "tiny.toml", "-o", "out"]
    processes = [subprocess.Popen(command, cwd=here, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    messages = ["", ""]

    def collect(index: int) -> None:
        messages[index] = processes[index].communicate()[1]

    threads = [threading.Thread(target=collect, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [process.returncode for process in processes] == [0, 0], messages
    said = "".join(messages)
    assert (said.count("render: done"), said.count("render: up to date")) == (1, 1), said
    assert {path.name for path in (here / RESULTS).iterdir()} == FILES
    assert {path.name for path in (here / "out").iterdir()} == {"tiny", "index.html"}
    assert content(here / RESULTS) == content(finished)


# --- links and pages in an output folder that was received


def test_a_link_out_of_the_output_folder_is_refused(here: Path, ommatid: Command) -> None:
    others = here / "others"
    for folder in (others, here / "out"):
        folder.mkdir()
    for name in ("run.json", "scene.toml"):
        (others / name).write_text("of another program", encoding="utf-8")
    (here / "out" / "tiny").symlink_to(others)
    before = {path: path.stat().st_mtime_ns for path in others.iterdir()}
    ended = ommatid("run", "tiny.toml")
    assert (ended.code, "got a link to" in ended.err) == (2, True)
    assert {path: path.stat().st_mtime_ns for path in others.iterdir()} == before


@pytest.mark.parametrize("command", [("run", "tiny.toml", "-o", "."), ("report", ".")])
def test_the_page_of_another_program_is_kept(command: tuple[str, ...], kept: Path, ommatid: Command) -> None:
    kept.rename(kept.parents[1] / "tiny")
    page = kept.parents[1] / "index.html"
    page.write_text("<!doctype html><title>My site</title>", encoding="utf-8")
    ended = ommatid(*command)
    assert (ended.code, "index.html: would be replaced" in ended.err) == (2, True)
    assert "My site" in page.read_text(encoding="utf-8")
