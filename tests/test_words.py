"""Persons for things: none of these words in code, messages and docs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from .modules import ROOT

PERSONS = re.compile(r"\b(whoever|somebody|nobody)\b", re.IGNORECASE)
TEXTS = ("py", "md", "html", "toml", "js")
NOT_OURS = {".venv", ".git", "out", "build", "dist"}


def texts() -> list[Path]:
    """Every text of the repository, by its own path (links are left out, this file too)."""
    root = ROOT.resolve()
    paths = [path for suffix in TEXTS for path in root.rglob(f"*.{suffix}") if path.is_file()]
    own = {path for path in paths if path.resolve() == path and not NOT_OURS & {*path.relative_to(root).parts}}
    return sorted(own - {Path(__file__).resolve()})


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT.resolve()))


@pytest.mark.parametrize("path", texts(), ids=relative)
def test_things_are_not_called_persons(path: Path) -> None:
    lines = enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
    assert [f"{number}: {line.strip()}" for number, line in lines if PERSONS.search(line)] == []
