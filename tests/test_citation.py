"""CITATION.cff names this software as it is packaged, and the paper that it implements."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from .modules import ROOT


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    yaml: Any = pytest.importorskip("yaml")
    citation: Any = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for key in ("version", "license"):
        assert citation[key] == project[key]
    assert citation["title"] == project["name"]
    assert {"cff-version", "message", "authors"} <= citation.keys()  # required by the format
    (paper,) = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Wood", "Rajan", "Christensen"]
    assert paper["title"] in " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
