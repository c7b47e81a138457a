"""Whatever a scene, an option or a name holds, terminals and pages get visible characters and short lines."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
import unicodedata
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from ommatid.cli import output
from ommatid.runtime.printable import LONGEST_MESSAGE
from ommatid.scenes.tables import toml

from ..conftest import TINY, Command, Ended, interpreter
from ..modules import modules

NOT_PRINTED = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
PIECES = [  # of terminals, of readers, of Rich, HTML, mathematics, spreadsheets and paths
    *("\x1b[31m", "\x1b]0;title\x07", "\x1b]8;;http://x\x1b\\", "\x1b]52;c;YQ==\x07", "\x9b2J", "\x07", "\r", "\n"),
    *("\t", "\x00"),
    *("\u202e", "\u2066", "\u200b", "\ufeff", "\u2028", "\ue000", "e" + "\u0301" * 40, "漢字", "\U0001f98b", "\u0378"),
    *("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "</title>", "{{7*7}}", "javascript:alert(1)"),
    *("[red]", "[/]", ":smile:", "$", r"$\frac{$", r"\N", "=1+1", "%s", "{0}", "'", '"', "\\", "x" * 300),
]  # fmt: skip
QUICK = ("--set", "calibration.method=ideal")


def hostile(seed: int, pieces: int = 12) -> str:
    """A text of some of the pieces in some order."""
    return "".join(random.Random(seed).sample(PIECES, pieces))


def quoted(text: str) -> str:
    """The text as a TOML value."""
    return toml.dumps({"k": text}).removeprefix("k = ").rstrip("\n")


def file_name(seed: int) -> str:
    """A name that the file system takes."""
    return hostile(seed, 5).replace("/", "|").replace("\x00", "").encode()[:150].decode(errors="ignore")


def check(ended: Ended, *codes: int) -> None:
    """Assert that only visible characters and short lines were printed."""
    assert ended.code in codes, ended.err
    for text, longest in ((ended.out, output.LONGEST_LINE), (ended.err, LONGEST_MESSAGE)):
        assert {c for c in text if c != "\n" and unicodedata.category(c) in NOT_PRINTED} == set()
        assert max(map(len, text.split("\n"))) <= longest
    assert "Traceback" not in ended.err
    assert "unexpected" not in ended.err


@pytest.fixture
def scene(here: Path) -> Path:
    """A scene of a hostile title."""
    path = here / "titled.toml"
    path.write_text(TINY.replace('"Tiny"', quoted(hostile(1, len(PIECES)))), encoding="utf-8")
    return path


@pytest.mark.usefixtures("scene")
def test_a_hostile_title_is_printed_harmlessly(ommatid: Command) -> None:
    for command in (
        ("show", "titled.toml"),
        ("show", "titled.toml", "--json"),
        ("predict", "titled.toml", "--no-rays"),
        ("predict", "titled.toml", "--no-rays", "--sweep", f"title={file_name(2)},={file_name(3)}", "-o", "swept"),
        ("design", "titled.toml"),
        ("run", "titled.toml", "--dry-run"),
        ("run", "titled.toml", "--dry-run", "--sweep", "title=\x1b[31m,\u202e"),
        ("calibrate", "titled.toml", "-o", "\x1b[31m.npz", *QUICK),
    ):
        check(ommatid(*command), 0)


@pytest.mark.usefixtures("scene")
def test_hostile_arguments_are_refused_harmlessly(here: Path, ommatid: Command) -> None:
    text = hostile(0).replace("\x00", "")
    name = file_name(0)
    for arguments in (
        *((option, text) for option in ("--set", "--lens", "--format", "--within", "--job")),
        *(("--set", f"{key}={text}") for key in ("target.image", "noise.variance", "camera.lens.I.name", text[:20])),
        *(("--scheduler", text), ("--sweep", text), ("--workers", text), (f"--{text}",)),
    ):
        check(ommatid("run", "titled.toml", "-o", "out", *arguments), 2)
    check(ommatid("run", "titled.toml", "-o", f"{name}/{name}", "--dry-run"), 0, 2)
    for command in (
        ("show",),
        ("import", "titled.toml", "-o", "x.exr"),
        ("reconstruct", "-o", "x"),
        ("report",),
        ("export", "-o", "x.xml"),
    ):
        check(ommatid(*command, name), 2)
    assert sorted(path.name for path in here.iterdir()) == ["tiny.toml", "titled.toml"]


class Elements(HTMLParser):
    """Counts the elements of a page with the names of their attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.counted: Counter[tuple[str, ...]] = Counter()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs if name != "class"]  # which depends on the length of texts
        self.counted[tag, *names] += 1
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src")]


def elements(path: Path) -> Elements:
    parser = Elements()
    parser.feed(path.read_text(encoding="utf-8"))
    return parser


@pytest.mark.slow
def test_a_hostile_title_adds_nothing_to_pages_and_figures(scene: Path, finished: Path, ommatid: Command) -> None:
    check(ommatid("run", scene.name, "-o", "out", "--format", "svg"), 0)
    check(ommatid("run", scene.name, "-o", "out", "-v"), 0)
    folder = scene.parent / "out" / "titled"
    page, plain = elements(folder / "report.html"), elements(finished / "report.html")
    assert page.counted == plain.counted
    index = elements(folder.parent / "index.html")
    assert not {tag for tag, *names in index.counted if any(name.startswith("on") for name in names)}
    assert sum(count for (tag, *_), count in index.counted.items() if tag == "script") == 1, "that which sorts"
    assert all(re.match(r"#|data:|[\w%.+-]+/", address) for address in (*page.addresses, *index.addresses))
    for path in (folder / "report.html", folder.parent / "index.html", *folder.glob("*.svg"), folder / "scene.toml"):
        text = path.read_text(encoding="utf-8")
        assert {c for c in text if c not in "\n\t" and unicodedata.category(c) in NOT_PRINTED} == set(), path.name
    for path in folder.glob("*.svg"):
        ElementTree.parse(path)
    stored = toml.loads((folder / "scene.toml").read_text(encoding="utf-8"))
    assert stored["title"] == hostile(1, len(PIECES))


def test_names_that_terminals_do_not_show_are_escaped(scene: Path, kept: Path, ommatid: Command) -> None:
    name = "a\x1b[31m\u202e<b>"
    shutil.copytree(kept, scene.parent / name / name)
    check(ommatid("report", name), 0)
    check(ommatid("report", f"{name}/{name}"), 0)
    check(ommatid("check", f"{name}/{name}/stack.exr", f"{name}/{name}/model.npz"), 0)
    check(
        ommatid("reconstruct", f"{name}/{name}/stack.exr", f"{name}/{name}/model.npz", "-o", f"{name}/x.exr", "-v"), 0
    )
    index = elements(scene.parent / name / "index.html")
    assert all(re.match(r"#|data:|[\w%.+-]+/", address) for address in index.addresses)


@pytest.mark.slow
def test_terminals_without_unicode_show_tables(here: Path) -> None:
    (here / "tiny.toml").rename(here / "t\x9bµ.toml")
    script = 'import sys; sys.argv[1:] = ["show", "t\\x9b\\xb5.toml", "-v"]'
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "TERM": "dumb", "COLUMNS": "40"}
    ended = subprocess.run(interpreter(script), cwd=here, env=environment, capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert not {byte for byte in ended.stdout if byte < 32 and byte != 10}
    assert b"Tiny" in ended.stdout
    assert ended.stdout.isascii()
    assert max(map(len, ended.stdout.splitlines())) <= 41


def test_other_modules_print_printable_sentences_alone() -> None:
    ours = ("cli.output", "cli.app", "cli.failures", "runtime.execution.library_warnings")
    printing = re.compile(r"^ +(?:print|typer\.echo|sys\.std(?:out|err)\.write)\((?!printable|.*file=answers)", re.M)
    found = {name for name, path in modules().items() if printing.search(path.read_text(encoding="utf-8"))}
    assert found <= {f"ommatid.{name}" for name in ours}
