"""Tasks on threads, processes and clusters: the same results on all of them, even if workers die."""

from __future__ import annotations

import errno
import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.execution import workers
from ommatid.runtime.execution.cluster import Cluster, worker_pool
from ommatid.runtime.progress import no_progress

from ..conftest import Command

# --- tasks, which are functions of a module since they are pickled by name


def digits(seed: int) -> list[float]:
    """Numbers that depend on the item alone, to the last bit."""
    return np.random.default_rng(seed).normal(size=100).cumsum().tolist()


def digits_and_process(seed: int) -> tuple[list[float], int]:
    return digits(seed), os.getpid()


def meets_the_other(folder: Path, item: int) -> int:
    """Process number; returned only once both items have begun, and so in two workers."""
    (folder / str(item)).touch()
    for _ in range(6000):
        if (folder / str(1 - item)).exists():
            return os.getpid()
        time.sleep(0.01)
    raise TimeoutError("one worker does nothing")


def digits_or_death(seed: int) -> list[float]:
    if seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return digits(seed)


class UnsendableError(Exception):
    def __init__(self, first: str, second: str) -> None:
        super().__init__(first)
        self.second = second


def raises_unsendable(item: int) -> None:
    raise UnsendableError("egg", str(item))


def fine_or_raises(item: type[Exception] | None) -> str:
    if item is not None:
        raise item("the picture is upside down; turn it")
    return "fine"


def process_number() -> dict[str, str]:
    return {"python": "3", "numpy": str(os.getpid())}


def python_version() -> dict[str, str]:
    return {"python": sys.version}


class OfUnknownModule:
    """A function of a module that the worker does not have, so that it cannot be unpickled there."""

    def __call__(self) -> dict[str, str]:
        return {}

    def __reduce__(self) -> tuple[Any, ...]:
        return importlib.import_module, ("no_such_module_anywhere",)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "PATIENCE", 0.3)


# --- results


ON_A_CLUSTER = pytest.param({"cluster": "address"}, marks=pytest.mark.slow)


@pytest.mark.parametrize("options", [{}, {"threads": 3}, {"count": 2}, ON_A_CLUSTER])
def test_results_are_in_the_order_of_the_items(options: dict[str, Any], request: pytest.FixtureRequest) -> None:
    progress: list[float] = []
    if "cluster" in options:
        options = {"cluster": Cluster(request.getfixturevalue("address"))}
    with worker_pool(**options) as pool:
        results = pool.map(digits_and_process, range(8), progress.append, 8)
    assert [values for values, _ in results] == [digits(seed) for seed in range(8)]
    assert progress == [(count + 1) / 8 for count in range(8)]
    in_this_process = {number for _, number in results} == {os.getpid()}
    assert in_this_process == (not options or "threads" in options)


def test_without_workers_tasks_are_done_one_by_one_and_items_made_when_needed() -> None:
    events: list[str] = []

    def items() -> Iterator[int]:
        for item in range(3):
            events.append(f"item {item}")
            yield item

    def task(item: int) -> int:
        events.append(f"task {item}")
        return item

    with worker_pool() as pool:
        for _, result in pool.each(task, items()):
            events.append(f"ended {result()}")
    assert events == [f"{event} {item}" for item in range(3) for event in ("item", "task", "ended")]


def test_threads_work_at_the_same_time() -> None:
    barrier = threading.Barrier(3)
    with worker_pool(threads=3) as pool:
        assert pool.map(lambda _: barrier.wait(timeout=30) >= 0, range(3), no_progress, 3) == [True] * 3


def test_processes_without_shared_memory_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Semaphores are files in /dev/shm, which may be full, or read-only."""

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("multiprocessing.synchronize.SemLock.__init__", full)
    refused = pytest.raises(MachineError, match=r"--workers: .*No space left.* make /dev/shm writable")
    with refused, worker_pool(count=2):
        pass


@pytest.mark.parametrize("error", [InputError, MachineError, ZeroDivisionError])
@pytest.mark.parametrize("remote", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_failure_is_the_same_here_and_on_a_cluster(
    error: type[Exception], remote: bool, request: pytest.FixtureRequest
) -> None:
    with worker_pool(Cluster(request.getfixturevalue("address")) if remote else None) as pool:
        with pytest.raises(error, match=r"^the picture is upside down; turn it$"):
            pool.map(fine_or_raises, [None, error, None], no_progress, 3)
        results = dict(pool.each(fine_or_raises, [None, error, None]))
        assert (results[0](), results[2]()) == ("fine", "fine")
        with pytest.raises(error, match="upside down"):
            results[1]()


def test_a_process_that_dies_ends_the_tasks_with_one_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    with (
        pytest.raises(MachineError, match=r"^a process died, .*; finished results stay, repeat the command"),
        worker_pool(count=2) as pool,
    ):
        pool.map(digits_or_death, range(6), no_progress, 6)
    assert capfd.readouterr().err == ""


def test_an_exception_that_cannot_be_sent_is_described() -> None:
    with worker_pool(count=2) as pool:
        results = dict(pool.each(raises_unsendable, range(2)))
        with pytest.raises(RuntimeError, match="UnsendableError: egg"):
            results[0]()


def test_processes_use_no_network_share_the_processors_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("scratch", "meeting"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    environment = dict(os.environ)
    with worker_pool(count=2) as pool:
        numbers = pool.map(partial(meets_the_other, tmp_path / "meeting"), range(2), no_progress, 2)
        processes = [psutil.Process(number) for number in numbers]
        assert [process.net_connections("inet") for process in processes] == [[], []]
        shares = [process.cpu_affinity() for process in processes]
        assert set().union(*shares) == set(psutil.Process().cpu_affinity())
        assert len(psutil.Process().cpu_affinity()) < 2 or not set(shares[0]) & set(shares[1])
    assert not any(process.is_running() for process in processes)
    assert list((tmp_path / "scratch").iterdir()) == []
    assert dict(os.environ) == environment


# --- errors


class IdleExecutor(Executor):
    """Accepts tasks and never executes them."""

    def __init__(self, *, cancelled: bool = False) -> None:
        self.cancelled = cancelled

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        del fn, args, kwargs
        future: Future[Any] = Future()
        if self.cancelled:
            future.cancel()
            future.set_running_or_notify_cancel()
        return future


class DyingExecutor(Executor):
    """Executes two tasks; its processes die when it is given a third."""

    def __init__(self) -> None:
        self.left = 2

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.left -= 1
        if self.left < 0:
            raise BrokenExecutor
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def test_results_that_were_there_when_processes_died_are_not_lost() -> None:
    """A process may die while the result before it is written."""
    results = workers.Workers(DyingExecutor(), lambda: 3).each(digits, range(4))
    assert [next(results)[1]() for _ in range(2)] == [digits(0), digits(1)]
    with pytest.raises(MachineError, match="a process died"):
        next(results)


@pytest.mark.usefixtures("impatient")
def test_a_cluster_that_loses_all_workers_is_not_waited_for() -> None:
    with pytest.raises(MachineError, match="no workers are left"):
        workers.Workers(IdleExecutor(), lambda: 0).map(digits, range(2), no_progress, 2)


def test_a_lost_connection_is_reported() -> None:
    with pytest.raises(MachineError, match="scheduler was lost"):
        workers.Workers(IdleExecutor(cancelled=True), lambda: 1).map(digits, range(2), no_progress, 2)


@pytest.mark.slow
def test_workers_with_other_versions_are_refused(address: str) -> None:
    with worker_pool(Cluster(address)) as pool:
        pool.check_versions(python_version)
        expected = rf"--scheduler {address}: .* numpy \d+, here {os.getpid()}; install the same versions"
        with pytest.raises(InputError, match=expected):
            pool.check_versions(process_number)
        with pytest.raises(InputError, match=r"no_such_module_anywhere.*install the same version of ommatid"):
            pool.check_versions(OfUnknownModule())


@pytest.mark.usefixtures("impatient")
def test_wrong_options_are_refused_in_one_line(here: Path, ommatid: Command) -> None:
    for options, message in (
        (
            ("--scheduler", "tcp://127.0.0.1:8786", "--workers", "2"),
            "--scheduler and --workers: expected one",
        ),
        (("--scheduler", "127.0.0.1:8786"), "expected an address such as tcp://"),
        (("--scheduler", "http://127.0.0.1:80"), "expected an address such as tcp://"),
        (("--scheduler", "tcp://127.0.0.1:1"), "--scheduler tcp://127.0.0.1:1: no scheduler answers there"),
        (("--workers", "0"), "--workers"),
    ):
        ended = ommatid("render", here / "tiny.toml", "-o", "out", *options)
        assert (ended.code, ended.out) == (2, "")
        [line] = ended.err.splitlines()
        assert line.startswith("ommatid: ")
        assert message in line
    assert not (here / "out").exists()
