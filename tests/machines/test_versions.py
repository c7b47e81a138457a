"""The versions of Python are the same wherever they are stated."""

from __future__ import annotations

import re
import tomllib

from tests.modules import ROOT

PREFIX = "Programming Language :: Python :: "


def test_the_pages_name_the_versions_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions = [line.removeprefix(PREFIX) for line in project["classifiers"] if line.startswith(PREFIX)]
    assert project["requires-python"] == f">={versions[0]}"
    stated = f"Python {', '.join(versions[:-1])} or {versions[-1]}"
    for page in ("README.md", "docs/install.md"):
        assert re.search(stated, (ROOT / page).read_text(encoding="utf-8")), page
