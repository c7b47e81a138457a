"""Links and pages in an output folder that was received: nothing is written where they lead."""

from __future__ import annotations

from pathlib import Path

import pytest

from ..conftest import Command


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
