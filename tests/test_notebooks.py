"""The notebooks of the documentation: the first is executed, and all are text notebooks that the site lists."""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib as mpl
import pytest

from .documentation import DOCS

NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.py"))


@pytest.mark.slow
def test_the_first_notebook_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A text notebook is a script; `make docs` executes all of them in kernels."""
    names: dict[str, object] = {}
    with mpl.rc_context({"backend": "Agg"}):
        exec(compile((DOCS / "notebooks" / "first_camera.py").read_text(encoding="utf-8"), "notebook", "exec"), names)
    assert "trusted" in capsys.readouterr().out.splitlines()
    assert list(tmp_path.iterdir()) == [], "files that it would leave behind"


def test_notebooks_have_cells_and_a_title() -> None:
    index = (DOCS / "notebooks" / "README.md").read_text(encoding="utf-8")
    site = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    for path in NOTEBOOKS:
        text = path.read_text(encoding="utf-8")
        ast.parse(text)
        assert text.startswith("# %% [markdown]\n# # ")
        assert text.count("\n# %%\n") >= 2, "cells of code"
        assert f"({path.name})" in index
        assert f"notebooks/{path.stem}.md" in site
    assert len(NOTEBOOKS) == 7
