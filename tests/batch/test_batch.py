"""Batches that are interrupted at any moment: the next run repeats nothing finished and gives the same files."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits  # pyright: ignore[reportMissingTypeStubs]

from ommatid.batch import batch
from ommatid.batch.batch import Batch, Member, Runs
from ommatid.batch.plan import concurrent_by_memory, estimate_cost, fastest_process_count
from ommatid.reconstruct import method_choice
from ommatid.reconstruct.method_choice import PROGRAM_MEMORY
from ommatid.runtime import files
from ommatid.runtime.processors import one_thread, processors

from ..conftest import TINY, Command, shell
from ..runs import FILES, MADE, assert_same_content, content
from .attempts import attempt, modification_times

COMMAND = ("run", "tiny.toml", "-o", "out", "--sweep", "render.seed=1,2", "--json")
SCENES = ("tiny+render.seed=1", "tiny+render.seed=2")
SHARED = ("index.html", "sweep.csv", "sweep.json", "sweep.png")
OUTPUT = {*SHARED, *(f"{scene}/{name}" for scene in SCENES for name in FILES)}
MOST_CHANGES = 60  # of files: a command is killed after a random number of changes up to this


def finished_files(times: dict[str, int], scene: str) -> dict[str, int]:
    """Files of finished stages. Those of the reconstruction are finished once run.json, the last, is there."""
    here = {name: times[f"{scene}/{name}"] for name in MADE if f"{scene}/{name}" in times}
    finished = MADE if "run.json" in here else ("stack.exr", "model.npz")
    return {f"{scene}/{name}": here[name] for name in finished if name in here}


def kill_and_resume(starter: subprocess.Popen[str], here: Path, workers: int, random: np.random.Generator) -> int:
    """Run a batch, kill it and resume it until it ends; check each attempt, and return the number of kills.

    workers : of the first attempt; the others use one process
    """
    here.mkdir()
    (here / "tiny.toml").write_text(TINY, encoding="utf-8")
    kills = 0
    while True:
        before = modification_times(here / "out")
        count = 1 if kills else workers
        ended = attempt(starter, here, (*COMMAND, "--workers", str(count)), int(random.integers(1, MOST_CHANGES)))
        after = modification_times(here / "out")
        finished = {scene: finished_files(before, scene) for scene in SCENES}
        for scene, times in finished.items():
            if f"{scene}/report.html" not in times:  # the time of the page is added to run.json once there is one
                times = {name: time for name, time in times.items() if name != f"{scene}/run.json"}
            assert {name: after.get(name) for name in times} == times, f"repeated after {kills} kills"
        if not ended.killed:
            break
        kills += 1
    for scene in SCENES:
        line = f"render: up to date, nothing to do, {Path('out') / scene / 'stack.exr'}"
        assert (line in ended.err) == (f"{scene}/stack.exr" in finished[scene])
    for name, stage in (("model.npz", "calibrate"), ("run.json", "reconstruct")):
        count = sum(f"{scene}/{name}" in finished[scene] for scene in SCENES)
        assert ended.err.count(f"{stage}: up to date") == count
    assert [document["values"] for document in json.loads(ended.out)] == [{"render.seed": "1"}, {"render.seed": "2"}]
    return kills


def rows_without_times(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [{name: value for name, value in row.items() if not name.startswith("seconds")} for row in rows]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory, starter: subprocess.Popen[str]) -> Path:
    """Output folder of a batch that is not killed."""
    here = tmp_path_factory.mktemp("uninterrupted")
    (here / "tiny.toml").write_text(TINY, encoding="utf-8")
    assert not attempt(starter, here, (*COMMAND, "--workers", "1"), sys.maxsize).killed
    assert modification_times(here / "out").keys() == OUTPUT
    return here / "out"


@pytest.mark.parametrize(("workers", "kills"), [(1, 8), (2, 1)])
def test_a_batch_that_is_killed_at_any_moment_is_resumed(
    workers: int, kills: int, starter: subprocess.Popen[str], tmp_path: Path, uninterrupted: Path
) -> None:
    random, killed = np.random.default_rng(5), 0
    expected = {scene: content(uninterrupted / scene) for scene in SCENES}
    while killed < kills:
        here = tmp_path / str(killed)
        killed += kill_and_resume(starter, here, workers, random)
        assert modification_times(here / "out").keys() == OUTPUT, "files are left over, or missing"
        for scene in SCENES:
            assert_same_content(here / "out" / scene, expected[scene])
        assert rows_without_times(here / "out" / "sweep.csv") == rows_without_times(uninterrupted / "sweep.csv")


def test_a_run_removes_the_temporary_files_of_a_killed_one(kept: Path, ommatid: Command) -> None:
    for name in (f".0123abcd{files.PART}estimate.png", ".stack.exr.partial.npz", ".model.npz.partial.npz"):
        (kept / name).write_bytes(b"half")
    ended = ommatid("run", "tiny.toml", "-o", "out")
    assert ended.err.count("up to date, nothing to do") == 4
    assert {path.name for path in kept.iterdir()} == FILES


def test_a_folder_named_as_a_temporary_file_stays(kept: Path, ommatid: Command) -> None:
    (kept / ".stack.exr.partial.npz").mkdir()
    ended = ommatid("render", "tiny.toml", "-o", "out", "--force")
    assert (ended.code, ended.err) == (0, "render: done, out/tiny/stack.exr\n")
    assert (kept / ".stack.exr.partial.npz").is_dir()


# --- the number of processes


def unused(*arguments: Any) -> Any:
    raise AssertionError(f"called with {arguments}")


@pytest.mark.parametrize(("fit", "cores", "expected"), [(9, 4, 3), (2, 4, 2), (1, 4, 1), (9, 2, 2), (9, 1, 1)])
def test_processes_are_limited_by_scenes_processors_and_memory(
    fit: int, cores: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "processors", lambda: cores)
    counts: list[int] = []

    class Counted(Batch):
        def _in_processes(self, members: Sequence[Member], count: int) -> Runs:
            counts.append(min(count, len(members)))
            yield from ()

        def _in_this_process(self, members: Sequence[Member]) -> Runs:
            counts.append(min(1, len(members)))
            yield from ()

    three = [Member(Path(f"{name}.toml"), Path(name)) for name in "abc"]
    counted = Counted(unused, unused, unused, unused, unused, lambda _: fit)
    for members, count in ((three, None), (three, 1), (three, 7), (three[:1], 7)):
        assert list(counted.run(members, count=count)) == []
    assert counts == [expected, 1, 3, 1]


def test_memory_is_that_of_the_largest_scenes(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    large = [Member(here / "tiny.toml", here, ("target.shape=[60,60]", "camera.lens.I.pixels=fit"))] * 3
    small = [Member(here / "tiny.toml", here), Member(here / "missing.toml", here)]
    needed = PROGRAM_MEMORY + 7 * 8 * 3600**2
    for free, expected in ((needed * 1.5, 1), (needed * 2.5, 2), (needed * 50, 5)):
        monkeypatch.setattr(method_choice, "free_memory", lambda free=free: 2 * int(free))
        assert concurrent_by_memory([estimate_cost(member, (), ()).memory for member in (*small, *large)]) == expected


@pytest.mark.parametrize(
    ("seconds", "most", "shared", "expected"),
    [
        ([3.0] * 8, 2, 2, 2),  # 2 + 12 s against 16.8
        ([2.0] * 2, 2, 2, 1),  # 2 + 2 s against 2.8: they end before a process has begun
        ([60.0, 3.0], 2, 2, 1),  # the large one would have one processor all the time
        ([3.0, 60.0, 60.0], 2, 2, 2),
        ([60.0] * 8, 1, 8, 1),  # no more than memory holds
    ],
)
def test_a_batch_uses_processes_if_that_is_faster(seconds: list[float], most: int, shared: int, expected: int) -> None:
    """In closed form for two processors: n equal scenes take n/2 of their time, or n (1 - 0.6/2) one by one."""
    assert fastest_process_count(seconds, most, shared) == expected


# --- threads of linear algebra


def test_linear_algebra_uses_one_thread_whatever_the_setting() -> None:
    def blas_threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2, "blas"):
        with one_thread():
            assert blas_threads() == {1}
        assert blas_threads() == {2} or processors() == 1


def test_a_run_with_more_threads_for_linear_algebra_gives_the_same_files(finished: Path, here: Path) -> None:
    before = "import os\nos.environ['OPENBLAS_NUM_THREADS'] = '2'"
    ended = shell("run", "tiny.toml", "-o", "out", cwd=here, before=before)
    assert ended.code == 0, ended.err
    assert_same_content(here / "out" / "tiny", content(finished))
