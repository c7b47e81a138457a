"""The result does not depend on the machine's settings, and nothing is written elsewhere.

tests/test_wheel.py runs the wheel, and `nox` other interpreters.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import matplotlib
import pytest

from ommatid.simulate.renderer.variant import unusable_reason

from ..runs import differences
from .variations import EVERYTHING, VARIATIONS, Variation, result, run

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


@pytest.mark.parametrize("variation", VARIATIONS, ids=lambda variation: variation.name)
def test_no_setting_changes_the_result(variation: Variation, finished: Path, tmp_path: Path) -> None:
    assert differences(result(run(variation, tmp_path)), result(finished)) == []


def finished_folder(elsewhere: Path) -> Path:
    return elsewhere / "scenes" / EVERYTHING.folder / "out" / "tiny"


def test_the_result_is_the_same_bit_for_bit(elsewhere: Path, finished: Path) -> None:
    assert differences(result(finished_folder(elsewhere)), result(finished)) == []


@pytest.mark.skipif(bool(unusable_reason("llvm_ad_mono")), reason="needs the fast backend")
def test_the_fast_backend_gives_the_same_bits_again(tmp_path: Path) -> None:
    options = ("--set", "render.variant=llvm_ad_mono", "--set", "calibration.method=transport")
    first, second = (run(one, tmp_path / one.name[:5], options) for one in (VARIATIONS[0], EVERYTHING))
    assert differences(result(second), result(first)) == []


def test_nothing_is_written_elsewhere(elsewhere: Path) -> None:
    """See docs/install.md, What is written where."""
    assert list((elsewhere / "temporary").iterdir()) == []
    assert {path.name for path in (elsewhere / "home").iterdir()} <= {".drjit"}
    assert {path.name for path in finished_folder(elsewhere).parents[1].iterdir()} == {"tiny.toml", "out"}
    assert [path for path in (elsewhere / "scenes").rglob(".*") if path.is_file()] == []


def test_no_time_is_negative_where_the_clock_goes_back(elsewhere: Path) -> None:
    report = json.loads((finished_folder(elsewhere) / "run.json").read_text(encoding="utf-8"))
    assert report["spent"]["start_up"] > 0.0
    assert min(stage["seconds"] for stage in report["stages"].values()) >= 0.0
