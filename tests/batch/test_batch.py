"""Batches: what a killed run left is removed, the number of processes, and threads of linear algebra."""

from __future__ import annotations

from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits  # pyright: ignore[reportMissingTypeStubs]

from ommatid.batch import plan
from ommatid.batch.batch import Member
from ommatid.batch.plan import concurrent_by_memory, estimate_cost, fastest_process_count
from ommatid.reconstruct import method_choice
from ommatid.reconstruct.method_choice import PROGRAM_MEMORY
from ommatid.runtime import files
from ommatid.runtime.machine import one_thread, processors

from ..conftest import Command, shell
from ..runs import FILES, assert_same_content, content


def test_a_run_removes_the_temporary_files_of_a_killed_one(kept: Path, ommatid: Command) -> None:
    for name in (f".0123abcd{files.PART}estimate.png", ".stack.exr.partial.npz", ".model.npz.partial.npz"):
        (kept / name).write_bytes(b"half")
    ended = ommatid("run", "tiny.toml", "-o", "out")
    assert ended.err.count("up to date, nothing to do") == 4
    assert {path.name for path in kept.iterdir()} == FILES


# --- the number of processes


@pytest.mark.parametrize(("fit", "cores", "expected"), [(9, 4, 3), (2, 4, 2), (1, 4, 1), (9, 2, 2), (9, 1, 1)])
def test_processes_are_limited_by_scenes_processors_and_memory(
    fit: int, cores: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "processors", lambda: cores)
    monkeypatch.setattr(plan, "concurrent_by_memory", lambda _: fit)
    monkeypatch.setattr(plan, "fastest_process_count", lambda _, most, __: most)
    three = [Member(Path(f"{name}.toml"), Path(name)) for name in "abc"]
    assert [plan.process_count(members) for members in (three, three[:1])] == [expected, 1]


def test_memory_is_that_of_the_largest_scenes(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    large = [Member(here / "tiny.toml", here, ("target.shape=[60,60]", "camera.lens.I.pixels=fit"))] * 3
    small = [Member(here / "tiny.toml", here), Member(here / "missing.toml", here)]
    needed = PROGRAM_MEMORY + 7 * 8 * 3600**2
    for free, expected in ((needed * 1.5, 1), (needed * 2.5, 2), (needed * 50, 5)):
        monkeypatch.setattr(method_choice, "free_memory", lambda free=free: 2 * int(free))
        monkeypatch.setattr(method_choice, "used_memory", lambda: 0)
        assert concurrent_by_memory([estimate_cost(member).memory for member in (*small, *large)]) == expected


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


@pytest.mark.slow
def test_a_run_with_more_threads_for_linear_algebra_gives_the_same_files(finished: Path, here: Path) -> None:
    before = "import os\nos.environ['OPENBLAS_NUM_THREADS'] = '2'"
    ended = shell("run", "tiny.toml", "-o", "out", cwd=here, before=before)
    assert ended.code == 0, ended.err
    assert_same_content(here / "out" / "tiny", content(finished))
