"""The list of claims names tests that exist."""

from __future__ import annotations

import re

from .modules import ROOT, tracked

LIST = (ROOT / "tests" / "CLAIMS.md").read_text(encoding="utf-8")


def test_the_files_and_tests_of_the_list_exist() -> None:
    files = set(re.findall(r"\btests/[\w/]+\.py\b", LIST))
    defined = {name for path in tracked("tests/**/*.py") for name in re.findall(r"^def (\w+)", path.read_text(), re.M)}
    assert len(files) > 60, "the list is read"
    assert sorted(name for name in files if not (ROOT / name).is_file()) == []
    assert sorted(set(re.findall(r"::(test_\w+)", LIST)) - defined) == []
