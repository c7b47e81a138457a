"""Jobs that share a batch: their numbers, their shares, and which of them describes the batch when all have ended."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.batch.batch import Member
from ommatid.batch.jobs import job_files
from ommatid.batch.jobs.array_job import ArrayJob, read_job
from ommatid.batch.jobs.job_plan import FOLDER, EndedScene, JobShare, join_jobs, shares
from ommatid.runtime.errors import InputError

SCENES = 7


def array(**variables: int) -> dict[str, str]:
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in variables.items()}


@pytest.mark.parametrize(
    ("text", "environment", "expected"),
    [
        ("2/3", {}, (2, 3)),
        ("2/3", array(ID=1), (2, 3)),  # what is written counts
        ("/8", array(ID=3, MIN=3, MAX=3, COUNT=1), (3, 8)),  # a single job, repeated
        ("/8", {"PBS_ARRAY_INDEX": "8"}, (8, 8)),
        ("auto", array(ID=2, MIN=1, MAX=4, COUNT=4), (2, 4)),
    ],
)
def test_the_number_of_a_job_is_written_or_that_of_the_array(
    text: str, environment: Mapping[str, str], expected: tuple[int, int]
) -> None:
    assert read_job(text, environment) == ArrayJob(*expected)


@pytest.mark.parametrize(
    ("text", "environment", "message"),
    [
        ("0/3", {}, "expected a job from 1 to 3, got 0"),
        ("4/3", {}, "expected a job from 1 to 3, got 4"),
        ("three", {}, "expected I/N, such as 2/8"),
        ("/3", {}, "neither SLURM_ARRAY_TASK_ID nor PBS_ARRAY_INDEX is set"),
        ("/3", array(ID=0), "got 0, which is SLURM_ARRAY_TASK_ID; submit the jobs as an array from 1 to 3"),
        ("/3", {"PBS_ARRAY_INDEX": "x"}, "as PBS_ARRAY_INDEX, got 'x'"),
        ("auto", {"PBS_ARRAY_INDEX": "1"}, "write I/N, or /N in an array of PBS"),
        ("auto", array(ID=0, MIN=0, MAX=3, COUNT=4), "got 4 of 0 to 3"),
        ("auto", array(ID=2, MIN=2, MAX=2, COUNT=1), "got 1 of 2 to 2; to repeat some jobs write /N"),
        ("auto", array(ID=1, MIN=1, MAX=7, COUNT=4), "got 4 of 1 to 7"),
    ],
)
def test_a_job_that_is_none_of_the_batch_is_refused(text: str, environment: Mapping[str, str], message: str) -> None:
    with pytest.raises(InputError) as raised:
        read_job(text, environment)
    assert message in str(raised.value)


@given(st.lists(st.floats(0, 1e6), max_size=30), st.integers(1, 40))
def test_every_scene_has_one_job_and_no_job_has_much_more_than_the_least(seconds: list[float], count: int) -> None:
    """Whatever a job got last, it had the least work before: it exceeds the least at most by that one scene."""
    parts = shares(seconds, count)
    assert len(parts) == count
    assert sorted(index for part in parts for index in part) == list(range(len(seconds)))
    loads = [sum(seconds[index] for index in part) for part in parts]
    assert max(loads) - min(loads) <= max(seconds, default=0.0) * (1 + 1e-12) + 1e-9
    assert (
        len(seconds) < count
        or max(seconds, default=0.0) > 0
        or {len(part) for part in parts}
        <= {
            len(seconds) // count,
            -(-len(seconds) // count),
        }
    )


# --- plans and records


def members_of(output: Path, count: int = SCENES) -> list[Member]:
    return [Member(Path("a.toml"), output / f"a+x={index}", (f"x={index}",)) for index in range(count)]


def joined(output: Path, number: int, count: int = 3, **changes: Any) -> JobShare:
    given: dict[str, Any] = {
        "everyone": members_of(output),
        "command": ("run",),
        "versions": lambda: {"scipy": "8"},
    } | changes
    return join_jobs(ArrayJob(number, count), output=output, cost=lambda _: 1.0, **given)


class Tables:
    """Collects the scenes that each description of the batch has, as their failures tell them apart."""

    def __init__(self) -> None:
        self.written: list[list[str]] = []

    def __call__(self, ended: Sequence[EndedScene]) -> None:
        self.written.append([scene.failure for scene in ended])


def run_job(output: Path, number: int, tables: Callable[[Sequence[EndedScene]], None], mark: str = "") -> str:
    share = joined(output, number)
    ended = [EndedScene(folder=member.folder.name, failure=f"{mark}{member.changes[0]}") for member in share.members]
    return share.end(ended, tables)[1]


def all_scenes(mark: str = "") -> list[str]:
    return [f"{mark}x={index}" for index in range(SCENES)]


def test_the_last_job_describes_the_batch_in_the_order_of_its_scenes(tmp_path: Path) -> None:
    tables = Tables()
    assert run_job(tmp_path, 2, tables) == "job 2 of 3: done; not ended yet: 1, 3"
    assert run_job(tmp_path, 3, tables) == "job 3 of 3: done; not ended yet: 1"
    assert tables.written == []
    assert run_job(tmp_path, 1, tables) == "job 1 of 3: done; all jobs have ended; 7 of 7 scenes failed"
    assert tables.written == [all_scenes()]
    names = {path.name for path in (tmp_path / FOLDER).iterdir()}
    assert names == {"1.plan.json", "1.job-1.json", "1.job-2.json", "1.job-3.json"}


def test_all_jobs_follow_the_plan_of_the_first(tmp_path: Path) -> None:
    """The estimated times of other machines may differ, and their shares with them."""
    members = members_of(tmp_path)

    def share(number: int, seconds: Sequence[float]) -> list[int]:
        job = ArrayJob(number, 2)
        joined = join_jobs(job, members, tmp_path, ("run",), lambda member: seconds[members.index(member)], dict)
        return [members.index(member) for member in joined.members]

    assert share(2, [9, 1, 1, 1, 1, 1, 1]) == [1, 2, 3, 4, 5, 6]
    assert share(1, [1, 1, 1, 1, 1, 1, 9]) == [0]


def test_a_job_without_scenes_waits_for_nothing(tmp_path: Path) -> None:
    shared = joined(tmp_path, 9, 9)
    assert shared.members == ()
    assert shared.end([], Tables())[1] == "job 9 of 9: nothing to do, all 7 scenes are those of other jobs"


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"command": ("render",)}, "expected 'run', not 'render'"),
        ({"everyone": members_of(Path("out"), 5)}, "expected 7 scenes, not 5: the first to differ is 'a+x=5'"),
        ({"count": 4}, "expected 3 jobs, not 4"),
        ({"versions": lambda: {"scipy": "9"}}, "the job that began first has scipy 8, here 9"),
    ],
)
def test_other_jobs_are_refused_until_those_of_the_folder_have_ended(
    change: dict[str, Any], difference: str, tmp_path: Path
) -> None:
    for number in (1, 2):
        run_job(tmp_path, number, Tables())
    before = {path.name: path.read_bytes() for path in (tmp_path / FOLDER).iterdir()}
    with pytest.raises(InputError) as raised:
        joined(tmp_path, 1, **change)
    assert difference in str(raised.value)
    assert f"delete {tmp_path / FOLDER} once none of them runs" in str(raised.value)
    assert {path.name: path.read_bytes() for path in (tmp_path / FOLDER).iterdir()} == before
    tables = Tables()
    run_job(tmp_path, 3, tables)
    assert tables.written == [all_scenes()]
    assert joined(tmp_path, 1, **change).number == 2
    with pytest.raises(InputError, match=r"have not ended|results would differ"):
        joined(tmp_path, 1)


def test_a_repeated_job_replaces_its_part_of_the_tables(tmp_path: Path) -> None:
    tables = Tables()
    for number in (1, 2, 3):
        run_job(tmp_path, number, tables)
    joined(tmp_path, 2)  # and is killed
    assert run_job(tmp_path, 1, tables) == "job 1 of 3: done; not ended yet: 2"
    run_job(tmp_path, 2, tables, "again ")
    assert len(tables.written) == 2
    assert tables.written[1] == [f"again x={index}" if index in (1, 4) else f"x={index}" for index in range(SCENES)]


class Killed(BaseException):
    """Stands for a kill: no `except Exception` stops it, and the mock below lets no `finally` touch a file."""


def kill_after(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kill at the file operation with this number, and let no later one happen, as a dead process would."""
    left = [steps]

    def killing(operation: Any) -> Any:
        def step(*arguments: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return operation(*arguments, **options)

        return step

    for owner, name in ((Path, "unlink"), (Path, "replace"), (Path, "open"), (os, "link"), (os, "fsync")):
        monkeypatch.setattr(owner, name, killing(getattr(owner, name)))


@pytest.mark.parametrize("victim", [1, 3])
def test_a_job_that_is_killed_at_any_step_is_repeated(
    victim: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first job makes the plan, and the last one the tables: both are killed at each of their steps in turn."""
    kills = 0
    for steps in range(1000):
        output, tables = tmp_path / str(steps), Tables()
        for number in range(1, victim):
            run_job(output, number, tables)
        (output / FOLDER).mkdir(parents=True, exist_ok=True)
        with monkeypatch.context() as patch:
            kill_after(steps, patch)
            try:
                run_job(output, victim, tables)
                ended = True
            except Killed:
                ended = False
        if ended:
            break
        kills += 1
        for number in range(victim, 4):
            run_job(output, number, tables)
        assert tables.written[-1] == all_scenes()
        assert {path.name for path in (output / FOLDER).iterdir()} == {
            "1.plan.json",
            *(f"1.job-{number}.json" for number in (1, 2, 3)),
        }
    assert kills > 10


def test_jobs_that_end_at_the_same_moment_make_one_description_at_a_time(tmp_path: Path) -> None:
    busy = threading.Lock()
    for turn in range(20):
        output, tables, start = tmp_path / str(turn), Tables(), threading.Barrier(3)

        def describe(ended: Sequence[EndedScene], tables: Tables = tables) -> None:
            assert busy.acquire(blocking=False), "two jobs describe the batch at once"
            tables(ended)
            busy.release()

        def work(number: int, output: Path = output, start: threading.Barrier = start, turn: int = turn) -> str:
            pause = threading.Event()
            start.wait()
            pause.wait(random.Random(3 * turn + number).uniform(0, 2e-3))
            return run_job(output, number, describe)

        with ThreadPoolExecutor(3) as pool:
            messages = list(pool.map(work, (1, 2, 3)))
        assert tables.written[-1:] == [all_scenes()], messages


def test_a_record_that_comes_while_the_tables_are_written_is_in_them(tmp_path: Path) -> None:
    tables, repeated = Tables(), list[str]()

    def describe(ended: Sequence[EndedScene]) -> None:
        tables(ended)
        if not repeated:  # another job, repeated, ends meanwhile
            repeated.append(run_job(tmp_path, 1, tables, "again "))

    for number in (1, 2, 3):
        run_job(tmp_path, number, describe)
    assert repeated == ["job 1 of 3: done; job 3 writes the tables, repeat it if it was stopped"]
    assert tables.written == [
        all_scenes(),
        [f"again x={index}" if index in (0, 3, 6) else f"x={index}" for index in range(SCENES)],
    ]


def test_a_file_system_without_links_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(job_files.os, "link", refuse)
    tables = Tables()
    for number in (1, 2, 3):
        run_job(tmp_path, number, tables)
    assert tables.written == [all_scenes()]


def test_a_damaged_file_of_the_jobs_is_named(tmp_path: Path) -> None:
    run_job(tmp_path, 1, Tables())
    run_job(tmp_path, 2, Tables())
    record = tmp_path / FOLDER / "1.job-1.json"
    record.write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"1\.job-1\.json: is damaged; repeat job 1"):
        run_job(tmp_path, 3, Tables())
    (tmp_path / FOLDER / "1.plan.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"1\.plan\.json: expected the plan of jobs"):
        joined(tmp_path, 1)
