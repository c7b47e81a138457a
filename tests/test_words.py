"""Plain English: no word for a person where a thing is meant, and one name a thing, in code and documentation."""

from __future__ import annotations

import re

from .modules import ROOT, tracked

PERSONS = re.compile(r"\b(whoever|somebody|nobody)\b", re.IGNORECASE)
SUFFIXES = (".py", ".md", ".html", ".toml", ".js", ".css", ".cff")


# Other names of things that docs/glossary.md names.
SYNONYMS = re.compile(
    r"\b(lenslets?|eyelets?|micro-cameras?|sub-?cameras?|nullspaces?|ground truth|gr[ae]y values?|gr[a]y levels?"
    r"|posterior deviations?|sub images?|dimensions unseen|system matrix|transfer matrix)\b",
    re.IGNORECASE,
)


def test_things_are_not_called_persons() -> None:
    assert not (found := lines_with(PERSONS)), "\n".join(found)


def test_a_thing_has_one_name() -> None:
    assert not (found := lines_with(SYNONYMS)), "\n".join(found)


def lines_with(words: re.Pattern[str]) -> list[str]:
    """Return the lines of code and documentation in which a word occurs."""
    checked = [path for path in tracked("**") if path.suffix in SUFFIXES and path.name != "test_words.py"]
    assert len(checked) > 300, "the list is that of the repository"
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in checked
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if words.search(line)
    ]
