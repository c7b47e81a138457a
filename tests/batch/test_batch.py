"""Batches that are broken off at any moment: the next run repeats nothing finished and ends with the same files."""

from __future__ import annotations

import csv
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits  # pyright: ignore[reportMissingTypeStubs]

from ommatid.batch import batch
from ommatid.batch.batch import Batch, Member, Works
from ommatid.batch.cost_model import concurrent_by_memory, estimate_cost, fastest_process_count
from ommatid.reconstruct import method_choice
from ommatid.reconstruct.method_choice import PROGRAM_MEMORY
from ommatid.runtime import files
from ommatid.runtime.processors import one_thread, processors

from ..conftest import TINY, Command, shell
from ..runs import FILES, MADE, content

COMMAND = ("run", "tiny.toml", "-o", "out", "--sweep", "render.seed=1,2", "--json")
SCENES = ("tiny+render.seed=1", "tiny+render.seed=2")
MOST_CHANGES = 60  # of the files of one attempt, after so many of which at most it is killed

# Starts commands that have everything imported already, so that each begins its work at once.
STARTER = """
import os, sys
import mitsuba, numba, scipy.linalg, skimage.metrics, matplotlib.backends.backend_agg
import ommatid.pipeline.stages, ommatid.analysis.depth_error, ommatid.analysis.study, ommatid.batch.sweep_table
import ommatid.reconstruct.output.figures, ommatid.reconstruct.output.run_json, ommatid.reconstruct.output.result_files
from ommatid.cli import app
for line in sys.stdin:
    number = os.fork()
    if number:
        print(number, os.waitpid(number, 0)[1], flush=True)
        continue
    os.setsid()
    folder, *sys.argv[1:] = line.split()
    os.chdir(folder)
    os.dup2(os.open("said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    os.dup2(os.open("told", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    open("number.new", "w").write(str(os.getpid()))
    os.rename("number.new", "number")
    try:
        app.main()
    except SystemExit as ended:
        os._exit(ended.code)
    finally:
        os._exit(99)
"""


@dataclass(frozen=True)
class Attempt:
    """A command that was killed, or ended by itself: what it said then."""

    killed: bool
    out: str
    err: str


def stamps(out: Path) -> dict[str, int]:
    """When each file below a folder was written, hidden ones included."""
    found: dict[str, int] = {}
    for folder, _, names in os.walk(out):
        for name in names:
            try:
                path = Path(folder) / name
                found[str(path.relative_to(out))] = path.stat().st_mtime_ns
            except FileNotFoundError:  # renamed meanwhile
                continue
    return found


def finished_in(found: dict[str, int], scene: str) -> dict[str, int]:
    """The files of stages that are done: each stands for itself, but for those of which run.json is the last."""
    here = {name: found.get(f"{scene}/{name}", 0) for name in MADE}
    done = ("stack.exr", "model.npz") if not here["run.json"] else MADE
    return {f"{scene}/{name}": here[name] for name in done if here[name]}


def attempt(starter: subprocess.Popen[str], here: Path, workers: int, changes: int) -> Attempt:
    """Run the command, and kill it and all its processes once its files have changed so often."""
    assert starter.stdin is not None
    assert starter.stdout is not None
    (here / "number").unlink(missing_ok=True)
    before, seen = stamps(here / "out"), 0
    starter.stdin.write(" ".join((str(here), *COMMAND, "--workers", str(workers))) + "\n")
    starter.stdin.flush()
    while not (here / "number").exists():
        time.sleep(0.001)
    group = int((here / "number").read_text(encoding="ascii"))
    while seen < changes and not select.select([starter.stdout], [], [], 0.001)[0]:
        now = stamps(here / "out")
        seen += len(now.items() ^ before.items())
        before = now
    if seen >= changes:
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)
    number, status = map(int, starter.stdout.readline().split())
    assert number == group
    killed = os.WIFSIGNALED(status)
    assert killed or os.waitstatus_to_exitcode(status) == 0, (here / "said").read_text(encoding="utf-8")
    told, said = ((here / name).read_text(encoding="utf-8") for name in ("told", "said"))
    return Attempt(killed, told, said)


def broken_off(starter: subprocess.Popen[str], here: Path, workers: int, random: np.random.Generator) -> int:
    """Run a batch, kill it, and resume it until it is done: how often it was killed.

    workers : of the first attempt; the others are made by one process
    """
    here.mkdir()
    (here / "tiny.toml").write_text(TINY, encoding="utf-8")
    kills = 0
    while True:
        before = stamps(here / "out")
        made = attempt(starter, here, 1 if kills else workers, int(random.integers(1, MOST_CHANGES)))
        after = stamps(here / "out")
        done = {scene: finished_in(before, scene) for scene in SCENES}
        for files_of_it in done.values():
            assert {name: after.get(name) for name in files_of_it} == files_of_it, f"repeated after {kills} kills"
        if not made.killed:
            break
        kills += 1
    for scene in SCENES:
        line = f"render: up to date, nothing to do, {Path('out') / scene / 'stack.exr'}"
        assert (line in made.err) == (f"{scene}/stack.exr" in done[scene])
    for name, stage in (("model.npz", "calibrate"), ("run.json", "reconstruct")):
        standing = sum(f"{scene}/{name}" in done[scene] for scene in SCENES)
        assert made.err.count(f"{stage}: up to date") == standing
    assert [one["values"] for one in json.loads(made.out)] == [{"render.seed": "1"}, {"render.seed": "2"}]
    return kills


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return [
            {name: value for name, value in row.items() if not name.startswith("seconds")}
            for row in csv.DictReader(stream)
        ]


def everything(out: Path) -> dict[str, Any]:
    """All that a batch wrote, without seconds."""
    found: dict[str, Any] = {
        f"{scene}/{name}": value for scene in SCENES for name, value in content(out / scene).items()
    }
    return found | {"sweep.csv": table(out / "sweep.csv")}


def all_files() -> set[str]:
    return {f"{scene}/{name}" for scene in SCENES for name in FILES} | {
        "index.html",
        "sweep.csv",
        "sweep.json",
        "sweep.png",
    }


@pytest.fixture(scope="module")
def starter() -> Generator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", STARTER], stdin=pipe, stdout=pipe, text=True) as process:
        yield process


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, starter: subprocess.Popen[str]) -> dict[str, Any]:
    """What a run that nobody kills writes."""
    here = tmp_path_factory.mktemp("undisturbed")
    (here / "tiny.toml").write_text(TINY, encoding="utf-8")
    assert not attempt(starter, here, 1, sys.maxsize).killed
    assert stamps(here / "out").keys() == all_files()
    return everything(here / "out")


@pytest.mark.parametrize(("workers", "kills"), [(1, 8), (2, 1)])
def test_a_batch_that_is_killed_at_any_moment_is_resumed(
    workers: int, kills: int, starter: subprocess.Popen[str], tmp_path: Path, undisturbed: dict[str, Any]
) -> None:
    random, killed = np.random.default_rng(5), 0
    while killed < kills:
        here = tmp_path / str(killed)
        killed += broken_off(starter, here, workers, random)
        assert stamps(here / "out").keys() == all_files(), "files are left over, or missing"
        found = everything(here / "out")
        assert found.keys() == undisturbed.keys()
        assert [name for name in found if found[name] != undisturbed[name]] == []


# --- what killed processes leave


def test_a_run_clears_what_one_that_was_killed_has_left(kept: Path, ommatid: Command) -> None:
    for name in (f".0123abcd{files.PART}estimate.png", ".stack.exr.partial.npz", ".model.npz.partial.npz"):
        (kept / name).write_bytes(b"half")
    ended = ommatid("run", "tiny.toml", "-o", "out")
    assert ended.err.count("up to date, nothing to do") == 4
    assert {path.name for path in kept.iterdir()} == FILES


# --- side by side


def nothing(*given: Any) -> Any:
    raise AssertionError(f"not asked for: {given}")


@pytest.mark.parametrize(("fit", "cores", "expected"), [(9, 4, 3), (2, 4, 2), (1, 4, 1), (9, 2, 2), (9, 1, 1)])
def test_as_many_scenes_are_done_side_by_side_as_there_are_processors_and_memory_for(
    fit: int, cores: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "processors", lambda: cores)
    seen: list[int] = []

    class Counted(Batch):
        def _beside(self, members: Sequence[Member], count: int) -> Works:
            seen.append(min(count, len(members)))
            yield from ()

        def _here(self, members: Sequence[Member]) -> Works:
            seen.append(min(1, len(members)))
            yield from ()

    three = [Member(Path(f"{name}.toml"), Path(name)) for name in "abc"]
    asked = Counted(nothing, nothing, nothing, nothing, nothing, lambda _: fit)
    assert list(asked.works(three)) == []
    assert list(asked.works(three, count=1)) == []
    assert list(asked.works(three, count=7)) == []
    assert list(asked.works(three[:1], count=7)) == []
    assert seen == [expected, 1, 3, 1]


def test_memory_is_asked_of_the_scenes_that_need_most(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    large = [Member(here / "tiny.toml", here, ("target.shape=[60,60]", "camera.lens.I.pixels=fit"))] * 3
    small = [Member(here / "tiny.toml", here), Member(here / "missing.toml", here)]
    needs = [PROGRAM_MEMORY + 7 * 8 * pixels**2 for pixels in (3600, 3600, 3600)]
    for free, expected in ((needs[0] * 1.5, 1), (needs[0] * 2.5, 2), (needs[0] * 50, 5)):
        monkeypatch.setattr(method_choice, "free_memory", lambda free=free: 2 * int(free))
        assert concurrent_by_memory([estimate_cost(member, (), ()).memory for member in (*small, *large)]) == expected


def test_a_batch_is_shared_where_that_is_sooner() -> None:
    """In closed form for two processors: n alike are done after n/2 of their time, or n (1 - 0.6/2) one by one."""
    assert fastest_process_count([3.0] * 8, 2, 2) == 2, "2 + 12 s against 16.8"
    assert fastest_process_count([2.0] * 2, 2, 2) == 1, "2 + 2 s against 2.8: they end before a process has begun"
    assert fastest_process_count([60.0, 3.0], 2, 2) == 1, "the large one would have one processor all the time"
    assert fastest_process_count([3.0, 60.0, 60.0], 2, 2) == 2
    assert fastest_process_count([60.0] * 8, 1, 8) == 1, "no more than memory holds"


def test_linear_algebra_is_done_by_one_thread_whatever_was_set_before() -> None:
    with threadpool_limits(2, "blas"):
        with one_thread():
            inside = {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}
        after = {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}
    assert inside == {1}
    assert after == {2} or processors() == 1


def test_a_run_with_more_threads_for_linear_algebra_gives_the_same_files(finished: Path, here: Path) -> None:
    before = "import os\nos.environ['OPENBLAS_NUM_THREADS'] = '2'"
    ended = shell("run", "tiny.toml", "-o", "out", cwd=here, before=before)
    assert ended.code == 0, ended.err
    found, expected = content(here / "out" / "tiny"), content(finished)
    assert [name for name in found if found[name] != expected[name]] == []
