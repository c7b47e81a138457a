"""The comparison of two runs notices what it must: a flipped bit, a shifted value, another verdict, a failed side."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from scipy import sparse

from .__main__ import judgement
from .cases import Case
from .checkout import MATRIX, Checkout, Done, NoCheckoutError
from .comparison import LIMITS, MODEL

CASE = Case("made-up", (), "out")
RNG = np.random.default_rng(1)
TRUTH = RNG.uniform(0, 255, (6, 5)).astype(np.float32)
NOISE = RNG.normal(0, 0.1, (2, 6, 5)).astype(np.float32)
REPORT: dict[str, Any] = {
    "date": "2026-01-01",
    "verdict": {"trusted": True, "reasons": []},
    "stages": {"render": {"seconds": 1.0, "samples": 64}},
    "error": {"mse": 0.0101, "expected_given_truth": {"mse": 0.01, "low": 0.007, "high": 0.014}},
    "diagnostics": {"chi_squared": {"chi_squared": 55.0, "expected": 60.0, "deviation": 11.0}},
}


def write(path: Path, **parts: dict[str, Any]) -> None:
    """Write an OpenEXR file of these parts."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File([OpenEXR.Part(dict(header), channels, name=name) for name, channels in parts.items()]).write(str(path))


def finished(folder: Path, **changes: Any) -> Done:
    """A folder of results as a run would leave it; changes : other arrays, H or leaves of run.json."""
    (folder / "out").mkdir(parents=True)
    readings: Any = changes.get("readings", (TRUTH + NOISE[0])[:4])
    views = {f"I.00.0{number}": {"Y": readings + np.float32(number)} for number in range(2)}
    write(folder / "out" / "stack.exr", **views)
    image = {"estimate": changes.get("estimate", TRUTH + NOISE[1])}
    image |= {"variance": changes.get("variance", np.full_like(TRUTH, 0.01)), "truth": TRUTH}
    write(folder / "out" / "estimate.exr", estimate=image)
    matrix = changes.get("H", sparse.csr_array(np.eye(40, 30)))
    sparse.save_npz(folder / MATRIX, matrix)
    variances = np.full(matrix.nnz, changes.get("variance_of_H", 0.0))
    np.savez(folder / "out" / MODEL, data=matrix.data, indices=matrix.indices, indptr=matrix.indptr, variance=variances)
    report = json.loads(json.dumps(REPORT))
    for path, value in changes.get("report", {}).items():
        *keys, last = path.split(".")
        place = report
        for key in keys:
            place = place[key]
        place[last] = value
    (folder / "out" / "run.json").write_text(json.dumps(report), encoding="utf-8")
    return Done(folder, 0, "", 1.0)


@pytest.fixture
def before(tmp_path: Path) -> Done:
    return finished(tmp_path / "before")


def compared(before: Done, statistical: bool = False, within: dict[str, float] | None = None, **changes: Any) -> str:
    """What is said of a run with these changes; empty if it is the same."""
    folder = before.folder.parent / "after"
    shutil.rmtree(folder, ignore_errors=True)
    limits = (LIMITS if statistical else {}) | (within or {})
    same, words = judgement(CASE, before, finished(folder, **changes), limits, statistical)
    return "" if same else words


def flipped(values: Any, place: tuple[int, int], bit: int = 0) -> Any:
    """The same values, but for one bit of one of them."""
    changed = values.copy()
    changed.view(np.uint32)[place] ^= 1 << bit
    return changed


def test_the_same_results_at_another_time_are_the_same_bit_for_bit(before: Done) -> None:
    assert compared(before, report={"date": "2027-01-01", "stages.render.seconds": 9.0, "spent": {"seconds": 3}}) == ""


def test_one_flipped_bit_is_noticed_in_every_array(before: Done) -> None:
    stack = compared(before, readings=flipped((TRUTH + NOISE[0])[:4], (2, 3)))
    assert stack.startswith("stack")
    assert "I.00.00 Y (2, 3)" in stack
    assert compared(before, estimate=flipped(TRUTH + NOISE[1], (5, 4))).endswith("at estimate estimate (5, 4)")
    assert compared(before, variance=flipped(np.full_like(TRUTH, 0.01), (0, 0))).startswith("deviation")
    data = np.ones(30)
    data[7] = np.nextafter(1, 2)
    matrix = sparse.csr_array((data, (range(30), range(30))), shape=(40, 30))
    assert compared(before, H=matrix) == "H 2.2e-16 of the largest entry at measurement 7, pixel 7"


def test_a_shift_is_measured_in_the_unit_of_its_quantity(before: Done) -> None:
    shifted = TRUTH + NOISE[1]
    shifted[1, 2] += np.float32(0.05)  # half an error bar
    assert compared(before, estimate=shifted) == "estimate 0.5 error bars at estimate estimate (1, 2)"
    assert compared(before, within={"estimate": 0.51}, estimate=shifted) == ""
    assert compared(before, within={"estimate": 0.49, "deviation": 1}, estimate=shifted) != ""
    assert compared(before, variance=np.full_like(TRUTH, 0.0102)).startswith("deviation 0.01 (relative)")
    assert compared(before, report={"error.mse": 0.0202}) == "numbers 0.5 (relative) at error.mse"
    interval = compared(before, report={"error.expected_given_truth.high": 0.028})
    assert interval == "interval 0.5 (relative) at error.expected_given_truth.high"


def test_numbers_that_are_none_and_other_shapes_are_beyond_every_finite_tolerance(before: Done) -> None:
    broken = TRUTH + NOISE[1]
    broken[0, 0] = np.nan
    assert compared(before, within={"estimate": 1e9}, estimate=broken).startswith("estimate inf")
    assert compared(before, within={"H": 1e9}, H=sparse.csr_array(np.eye(41, 30))).startswith("H inf")
    assert compared(before, within={"stack": 1e9}, readings=TRUTH[:3]).startswith("stack inf")


def test_another_verdict_is_noticed_in_every_kind_of_comparison(before: Done) -> None:
    change: dict[str, Any] = {"report": {"verdict.trusted": False}}
    assert "verdict" in compared(before, **change)
    assert "verdict" in compared(before, within=dict.fromkeys(LIMITS, 9.0) | {"verdict": 0.0}, **change)
    assert "verdict" in compared(before, statistical=True, **change)
    assert "verdict.reasons" in compared(before, report={"verdict.reasons": ["the residual is large"]})


def test_a_case_that_fails_on_one_side_or_on_both_differs(before: Done) -> None:
    failed = Done(before.folder, 2, "run: unknown key", 1.0)
    for sides, words in (((before, failed), "after fails (2): run"), ((failed, failed), "before fails (2): run")):
        same, said = judgement(CASE, *sides, LIMITS, False)
        assert not same
        assert said.startswith(words)


def test_another_draw_of_the_noise_is_statistically_the_same_and_a_bias_is_not(before: Done) -> None:
    rng = np.random.default_rng(2)
    draw = TRUTH + rng.normal(0, 0.1, TRUTH.shape).astype(np.float32)
    again: dict[str, Any] = {"estimate": draw, "readings": draw[:4], "report": {"error.mse": 0.011}}
    assert compared(before, statistical=True, **again) == ""
    assert compared(before, **again) != ""
    biased: list[tuple[dict[str, Any], str]] = [
        ({"readings": draw[:4] + np.float32(0.3)}, "stack"),
        ({"estimate": draw + np.float32(1.0)}, "estimate"),
        ({"variance": np.full_like(TRUTH, 0.012)}, "deviation"),
        ({"H": sparse.csr_array(np.eye(40, 30) * 1.1)}, "H"),
        ({"report": {"error.mse": 0.03}}, "interval"),
        ({"report": {"diagnostics.chi_squared.chi_squared": 160.0}}, "numbers"),
    ]
    for change, quantity in biased:
        assert compared(before, statistical=True, **(again | change)).startswith(quantity)


def test_two_draws_of_h_are_as_far_apart_as_their_variances_say(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.1, 1, (40, 30))

    def draw(deviation: float, bias: float = 0.0) -> Any:
        return sparse.csr_array(truth + bias + rng.normal(0, deviation, truth.shape))

    before = finished(tmp_path / "before", H=draw(0.1), variance_of_H=0.01)

    def said(matrix: Any, variance: float) -> str:
        return compared(before, statistical=True, H=matrix, variance_of_H=variance)

    assert said(draw(0.1), 0.01) == ""
    assert said(draw(0.3), 0.09) == ""
    assert said(draw(0.1, bias=0.3), 0.01).startswith("scatter")
    assert said(draw(0.3), 0.01).startswith("scatter")
    assert said(draw(0.1), 0.09).startswith("scatter"), "an overstated one"
    assert said(sparse.csr_array(truth), 0.0) == "", "of a side without variances"


PROGRAM = """
import os, pathlib, sys
pathlib.Path("words.txt").open("a").write(" ".join(sys.argv[1:]) + chr(10))
assert "OMMATID_X" not in os.environ and not sys.path[0].endswith("once")
sys.exit({code})
"""


def test_a_finished_case_is_not_run_again_by_the_same_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMMATID_X", "a setting of the user")
    program = tmp_path / "program"
    (program / "ommatid").mkdir(parents=True)
    (program / "ommatid" / "__init__.py").touch()
    (program / "ommatid" / "__main__.py").write_text(PROGRAM.format(code=0))
    case = Case("once", (("run", "a.toml"), ("reconstruct", "b.exr")), "out", {"a.toml": "text"})

    def ended() -> Done:
        return Checkout(program, Path(sys.executable), tmp_path / "store", ("render.seed=1",)).run(case)

    assert [ended().reused, ended().reused] == [False, True]
    words = (tmp_path / "store" / "once" / "words.txt").read_text().splitlines()
    assert words == ["run a.toml --set render.seed=1", "reconstruct b.exr", "export out/model.npz -o H.npz"]
    (program / "ommatid" / "__main__.py").write_text(PROGRAM.format(code="1 + 2"))  # of another length: bytecode
    failed = ended()
    assert (failed.code, failed.reused, failed.message) == (3, False, "run: no message")
    with pytest.raises(NoCheckoutError, match="in place of"):
        assert Checkout(tmp_path, Path(sys.executable), tmp_path / "store").identity
