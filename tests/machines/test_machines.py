"""The result does not depend on the machine's settings, and nothing is written elsewhere.

`python -m tests.machines` tries each setting alone, a wheel, and other interpreters.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import matplotlib
import pytest

from .variations import EVERYTHING, differences, result, run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of a run among unusual settings: home, temporary and base folders are below it."""
    base = tmp_path_factory.mktemp("m")
    places = {"HOME": str(base / "home"), "TMPDIR": str(base / "temporary"), "MPLCONFIGDIR": matplotlib.get_cachedir()}
    for name in ("home", "temporary"):
        (base / name).mkdir()
    run(replace(EVERYTHING, variables={**EVERYTHING.variables, **places}), base / "scenes")
    return base


def finished_folder(elsewhere: Path) -> Path:
    return elsewhere / "scenes" / EVERYTHING.folder / "out" / "tiny"


def test_the_result_is_the_same_bit_for_bit(elsewhere: Path, finished: Path) -> None:
    assert differences(result(finished_folder(elsewhere)), result(finished)) == []


def test_nothing_is_written_elsewhere(elsewhere: Path) -> None:
    """See docs/install.md, What is written where."""
    assert list((elsewhere / "temporary").iterdir()) == []
    assert {path.name for path in (elsewhere / "home").iterdir()} <= {".drjit"}
    assert {path.name for path in finished_folder(elsewhere).parents[1].iterdir()} == {"tiny.toml", "out"}
    assert [path for path in (elsewhere / "scenes").rglob(".*") if path.is_file()] == []


def test_no_time_is_negative_where_the_clock_goes_back(elsewhere: Path) -> None:
    spent = json.loads((finished_folder(elsewhere) / "run.json").read_text(encoding="utf-8"))["spent"]
    assert spent["start_up"] > 0.0
    assert spent["seconds"] > 0.0
    assert min(spent["stages"].values()) >= 0.0
