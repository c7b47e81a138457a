"""Plain English: no word for a person where a thing is meant, in code, messages and documentation."""

from __future__ import annotations

import re

from .modules import ROOT

PERSONS = re.compile(r"\b(whoever|somebody|nobody)\b", re.IGNORECASE)
SUFFIXES = (".py", ".md", ".html", ".toml", ".js", ".css", ".cff")
FOLDERS = ("docs", "ommatid", "reconstruct", "scenes", "simulate", "tests")


def test_things_are_not_called_persons() -> None:
    files = [path for name in FOLDERS for path in (ROOT / name).rglob("*") if path.suffix in SUFFIXES]
    files += [path for path in ROOT.iterdir() if path.suffix in SUFFIXES]
    checked = {path.resolve() for path in files}
    assert len(checked) > 300, "the walk finds the repository"
    checked.remove(ROOT.joinpath("tests", "test_words.py").resolve())
    found = [
        f"{path.relative_to(ROOT.resolve())}:{number}: {line.strip()}"
        for path in sorted(checked)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if PERSONS.search(line)
    ]
    assert not found, "\n".join(found)
