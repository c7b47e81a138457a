"""The command `check`, the part of run.json and the section of the page that show the same check."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ommatid as interface
from ommatid.page.data import read_run
from ommatid.page.sections import page
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.verdict_words import held_out_rows
from ommatid.scenes import stack as stack_file

from ..conftest import Command
from ..runs import document


@pytest.fixture
def altered(kept: Path) -> Path:
    """A run whose sub-imager I.01.01 recorded something else."""
    stack = stack_file.read(kept / "stack.exr")
    values = stack.values.copy()
    values[stack.camera.slices()[4]] += np.array([120.0, -120.0, 120.0] * 3)
    stack_file.write(kept / "stack.exr", replace(stack, values=values))
    return kept


def test_the_command_says_that_a_run_agrees(kept: Path, ommatid: Command) -> None:
    ended = ommatid("check", kept / "stack.exr", kept / "model.npz", "--strict")
    assert ended.code == 0
    assert "all 9 sub-imagers agree" in " ".join(ended.out.replace("│", " ").split())
    assert "fitted to the stack" in " ".join(ended.out.replace("│", " ").split())


def test_the_command_names_the_sub_imager_that_is_wrong(altered: Path, ommatid: Command) -> None:
    files = altered / "stack.exr", altered / "model.npz"
    ended = ommatid("check", *files, "--strict")
    assert ended.code == 3
    text = " ".join(ended.out.replace("│", " ").split())
    assert "not to be trusted: sub-imager I.01.01 contradicts the others" in text
    found = document(ommatid("check", *files, "--json", "--scene-prior"))
    assert found["verdict"]["trusted"] is False
    assert [sub["name"] for sub in found["sub_imagers"] if sub["named"]] == ["I.01.01"]
    assert found["prior"]["kind"] == "independent"
    assert not found["prior"]["fitted"]
    wrong = found["sub_imagers"][4]
    assert (wrong["type"], wrong["k"], wrong["l"], wrong["pixels"], wrong["expected"]) == ("I", 1, 1, 9, 9.0)
    assert wrong["rms_error"] / wrong["expected_rms"] == pytest.approx((wrong["chi_squared"] / 9) ** 0.5)


def test_python_and_the_command_yield_the_same_numbers(kept: Path, ommatid: Command) -> None:
    found = document(ommatid("check", kept / "stack.exr", kept / "model.npz", "--json"))
    check = interface.check(interface.read_stack(kept / "stack.exr"), interface.read_model(kept / "model.npz"))
    assert check.p_value == found["p_value"]
    assert [entry.z for entry in check.sub_imagers] == [sub["z"] for sub in found["sub_imagers"]]


def test_a_run_stores_its_check_and_the_page_shows_it(altered: Path, ommatid: Command) -> None:
    original = run_json.read(altered)
    assert original.held_out is not None
    assert original.held_out.verdict.trusted
    report = document(ommatid("reconstruct", altered / "stack.exr", altered / "model.npz", "-o", "again.exr", "--json"))
    wrong = run_json.RunReport.model_validate(report).held_out
    assert wrong is not None
    run = read_run(altered)
    shown = page(replace(run, report=run.report.with_changes(held_out=wrong)), None, "stamp")
    section = shown.split('<details id="held-out"')[1].split("</details>")[0]
    assert "not to be trusted: sub-imager I.01.01 contradicts the others" in section
    named = re.findall(r'<th scope="row">\s*(I[^<]*)</th><td>[^<]*contradicts the others</td>', section)
    assert named == ["I.01.01"]
    without = page(replace(run, report=run.report.with_changes(held_out=None)), None, "stamp")
    assert "ommatid check stack.exr model.npz" in without.split('<details id="held-out"')[1].split("</details>")[0]


def test_without_others_the_table_says_that_nothing_was_checked(kept: Path) -> None:
    stack, model = interface.read_stack(kept / "stack.exr"), interface.read_model(kept / "model.npz")
    values = np.full_like(stack.values, np.nan)
    values[:9] = stack.values[:9]
    report = interface.check(replace(stack, values=values), model)
    assert report.verdict.trusted is None
    assert held_out_rows(report)[0][1].startswith("not checked: fewer than two sub-imagers")
    assert json.loads(report.model_dump_json())["p_value"] is None
