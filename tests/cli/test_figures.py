"""Figures of the commands in the formats that are asked for, beside PNG, and the drawing of `show`."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..conftest import Command

STARTS = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
RUN = ("run", "tiny.toml", "-o", "out")


def figures(folder: Path, stem: str) -> set[str]:
    """Suffixes of the files of a figure, which are what their names say."""
    found = {path.suffix: path.read_bytes() for path in folder.glob(f"{stem}.*") if path.suffix in STARTS}
    assert all(content.startswith(STARTS[suffix]) for suffix, content in found.items())
    return set(found)


def test_a_finished_run_gets_figures_in_other_formats(here: Path, finished: Path, ommatid: Command) -> None:
    shutil.copytree(finished, here / "out" / "tiny")
    kept = (here / "out" / "tiny" / "run.json").read_bytes()
    ended = ommatid(*RUN, "--format", "npy,svg,pdf")
    assert ended.code == 0, ended.err
    assert "reconstruct: up to date" in ended.err
    assert figures(here / "out" / "tiny", "overview") == set(STARTS)
    assert (here / "out" / "tiny" / "estimate.npy").is_file()
    assert (here / "out" / "tiny" / "run.json").read_bytes() == kept
    ommatid(*RUN)
    assert figures(here / "out" / "tiny", "overview") == set(STARTS), "they still show this result"


def test_a_new_result_leaves_no_figure_of_an_older_one(here: Path, finished: Path, ommatid: Command) -> None:
    shutil.copytree(finished, here / "out" / "tiny")
    (here / "out" / "tiny" / "overview.pdf").write_bytes(b"%PDF of the run before")
    assert ommatid(*RUN, "--set", "prior.variance=5000").code == 0
    assert figures(here / "out" / "tiny", "overview") == {".png"}


def test_a_sweep_is_drawn_in_every_format(here: Path, ommatid: Command) -> None:
    swept = ("--no-rays", "--sweep", "noise.variance=1e-2,1", "-o", "out")
    assert ommatid("predict", "tiny.toml", *swept, "--format", "svg").code == 0
    assert figures(here / "out", "sweep") == {".png", ".svg"}


def test_show_draws_the_camera(here: Path, ommatid: Command) -> None:
    ended = ommatid("show", "tiny.toml", "--figure", "camera.svg")
    assert ended.code == 0, ended.err
    assert figures(here, "camera") == {".svg"}
    assert "camera.svg: written" in ended.err
    assert "lens pitch" in (here / "camera.svg").read_text(encoding="utf-8")
