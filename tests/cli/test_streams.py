"""Commands print on every terminal: closed, narrow, dumb, or without the letters of a title."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import TINY, Ended, shell

ASCII_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
SCENE = TINY.replace('title = "Tiny"', 'title = "Ξ Café →"')
DIGITS = "2.0123456789"


def run(words: str, cwd: Path, before: str = "", **variables: str) -> Ended:
    """Run a command in a shell, after the shell commands `before`."""
    command = f'{before} exec "{sys.executable}" -m ommatid {words}'
    environment = {**os.environ, **variables}
    ended = subprocess.run(["sh", "-c", command], cwd=cwd, env=environment, capture_output=True, check=False)
    return Ended(ended.returncode, ended.stdout.decode(), ended.stderr.decode())


@pytest.fixture
def cafe(tmp_path: Path) -> Path:
    (tmp_path / "café.toml").write_text(SCENE, encoding="utf-8")
    return tmp_path


@pytest.mark.slow
def test_letters_that_the_terminal_lacks_are_escaped(cafe: Path) -> None:
    """In this locale, even the name of the file has letters that the encoding lacks; colours are escapes, too."""
    ended = run("show café.toml", cafe, TERM="dumb", NO_COLOR="1", FORCE_COLOR="1", **ASCII_LOCALE)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.isascii()
    assert "\x1b[3" not in ended.out
    assert r"\u039e Cafe ->" in ended.out


@pytest.mark.slow
def test_a_run_in_the_plainest_locale(cafe: Path) -> None:
    """Libraries in C take names in UTF-8 in every locale."""
    ended = run("render café.toml -o 'größe'", cafe, **ASCII_LOCALE)
    assert ended.code == 0, ended.err
    assert {path.name for path in cafe.iterdir()} == {"café.toml", "größe"}
    assert (cafe / "größe" / "café" / "stack.exr").is_file()


def test_closed_streams_are_no_files(cafe: Path) -> None:
    """The first file that is opened would take the number of a closed stdout, and hold what is printed."""
    expected = shell("init", "new.toml", cwd=cafe)
    ended = run("init again.toml", cafe, before="exec <&- >&- 2>&-;")
    assert (expected.code, ended.code) == (0, 0)
    assert (cafe / "again.toml").read_bytes() == (cafe / "new.toml").read_bytes()


def test_no_number_is_cut_off_in_a_narrow_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from ommatid.cli.output import print_tables
    from ommatid.pipeline.sections import Section

    section: Section = ("Title", [("a value", DIGITS), ("another", "a long sentence about it " * 5)])
    for columns in ("40", "10", "0", "-1", "many"):
        monkeypatch.setenv("COLUMNS", columns)
        print_tables([section])
        out = capsys.readouterr().out
        assert DIGITS in out
        assert "…" not in out
        assert "Title" in out
