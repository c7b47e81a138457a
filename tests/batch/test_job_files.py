"""Plans of jobs, tables of sweeps and other JSON beside the results that were made to mislead."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from ommatid.batch.batch import Member
from ommatid.batch.jobs.array_job import ArrayJob
from ommatid.batch.jobs.job_plan import join_jobs
from ommatid.batch.sweep_row import read_rows
from ommatid.bench import table
from ommatid.reconstruct.output import run_json
from ommatid.runtime.errors import InputError

NESTED = "[" * 10_000 + "]" * 10_000
TEXTS = [NESTED, '{"a":' * 10_000, "9" * 5000, "1e400", "NaN", '"\\ud800"', "", "\ufeff{}", "[]", '{"jobs": "x"}']
PLAN: dict[str, Any] = {"jobs": 2, "command": ["run"], "scenes": {"s": ["s.toml"]}, "versions": {}, "shares": [[0], []]}
PLANS: dict[str, dict[str, Any]] = {
    "jobs without end": {"jobs": 10**9, "shares": []},
    "no job": {"jobs": 0, "shares": []},
    "no shares": {"shares": []},
    "a scene that is not there": {"shares": [[7], []]},
    "a scene twice": {"shares": [[0], [0]]},
    "no scene": {"shares": [[], []]},
    "more shares": {"shares": [[0], [], []]},
}


def join(folder: Path) -> None:
    """Join the jobs of a folder."""
    member = Member(Path("s.toml"), folder / "s", ())
    join_jobs(ArrayJob(1, 2), [member], folder, ["run"], lambda _: 1.0, dict)


def refused(path: Path, text: str) -> list[str]:
    """What the readers of JSON say of a text."""
    path.write_text(text, encoding="utf-8")
    said: list[str] = []
    for read in (read_rows, table.read, lambda file: run_json.read(file.parent)):
        with pytest.raises(InputError) as refusal:
            read(path)
        said.append(str(refusal.value).replace(str(path), ""))
    return said


@pytest.mark.parametrize("text", [text for text in TEXTS if text != "[]"])
def test_json_of_another_kind_is_refused_in_a_short_sentence(text: str, tmp_path: Path) -> None:
    assert all(len(sentence) <= 300 for sentence in refused(tmp_path / "run.json", text))


@pytest.mark.parametrize("text", [*TEXTS, *(json.dumps(PLAN | change) for change in PLANS.values())])
def test_plans_of_another_kind_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / ".jobs").mkdir()
    (tmp_path / ".jobs" / "1.plan.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="expected the plan of jobs") as refusal:
        join(tmp_path)
    assert len(str(refusal.value).replace(str(tmp_path), "")) <= 300


def test_fifos_are_refused(tmp_path: Path) -> None:
    (tmp_path / ".jobs").mkdir()
    os.mkfifo(tmp_path / ".jobs" / "1.plan.json")
    os.mkfifo(tmp_path / "run.json")
    with pytest.raises(InputError):
        join(tmp_path)
    for read in (read_rows, table.read, lambda file: run_json.read(file.parent)):
        with pytest.raises(InputError, match="expected a regular file, got a FIFO"):
            read(tmp_path / "run.json")
