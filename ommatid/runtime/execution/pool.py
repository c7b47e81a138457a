"""Workers of this machine: this process, its threads, or other processes; or those of a Dask cluster.

Each process is a fresh interpreter (a fork would keep only one of the renderer's threads) that runs one task at a time
on its own share of the processors. Ctrl-C may reach all processes or only this one; it interrupts every running task
once, and unfinished tasks save their checkpoints. No process outlives this one. If one dies, so do the others: what is
finished stays.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import get_context
from threading import Thread, Timer
from time import sleep
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from ..errors import InputError, MachineError
from .interpreter import ignore_configurations, import_path, python_environment
from .library_warnings import library_warnings, warn_on_stderr
from .workers import Workers, with_error_to_send

if TYPE_CHECKING:
    from .cluster import Cluster

Result = TypeVar("Result")

PATIENCE = 10.0  # seconds for a task to stop after it was interrupted
POLL = 1.0  # seconds between two checks of a process for its parent

_until_exit = ExitStack()  # of a worker process


class _SerialExecutor(Executor):
    """Executes a task when it is submitted."""

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def worker_pool(cluster: Cluster | None = None, count: int | None = None, threads: int = 1) -> Generator[Workers]:
    """Start or connect to workers: those of `cluster`, or `count` processes, or `threads` of this process.

    A count of 1 is this process. Raises InputError, which names the option, if there is no such cluster.
    """
    check_options(cluster, count)
    if cluster is not None:
        from .cluster import cluster_workers

        with cluster_workers(cluster) as workers:
            yield workers
    elif count is not None and count > 1:
        with ProcessPool(count) as pool:
            yield Workers(pool, lambda: count)
    else:
        with _SerialExecutor() if threads == 1 else ThreadPoolExecutor(threads) as executor:
            yield Workers(executor, lambda: threads)


def check_options(cluster: Cluster | None, count: int | None) -> None:
    """Raise InputError if --scheduler contradicts --workers, or if the cluster's options cannot be used."""
    if cluster is None:
        return
    if count is not None:
        raise InputError(
            "--scheduler and --workers: expected one of them; the first names a cluster, the second processes here"
        )
    cluster.check()


class ProcessPool(ProcessPoolExecutor):
    """Executor with `count` processes. Shutting down interrupts running tasks."""

    def __init__(self, count: int) -> None:
        """Prepare the processes, which are started when they are needed. Raises MachineError without semaphores."""
        context = get_context("spawn")
        try:
            with _safe_start():
                numbers: Any = context.SimpleQueue()
                super().__init__(count, context, _begin, (numbers, count, os.getpid()))
        except OSError as error:
            raise MachineError(
                f"--workers: no processes could be started ({error.strerror}); make /dev/shm writable and free some of"
                " it, or take --workers 1"
            ) from error
        for number in range(count):
            numbers.put(number)

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Execute `fn` in one of the processes."""
        with _safe_start():
            return super().submit(_interruptible, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Interrupt every task, and kill the processes of those that do not stop in time."""
        del wait, cancel_futures
        processes = list((self._processes or {}).values())
        for process in processes:
            if process.pid is not None:
                with suppress(OSError):  # it has ended
                    os.kill(process.pid, signal.SIGINT)
        killing = Timer(PATIENCE, lambda: [process.kill() for process in processes])
        killing.start()
        super().shutdown(cancel_futures=True)
        killing.cancel()


@contextmanager
def _safe_start() -> Generator[None]:
    """Let a process that starts now import nothing from the current folder, nor execute a user's script again.

    It ignores Ctrl-C until it is ready.
    """
    variables, path, script = dict(os.environ), list(sys.path), sys.modules["__main__"]
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    _set_environment(python_environment())
    sys.path[:] = import_path()
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        sys.path[:] = path
        _set_environment(variables)
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _set_environment(variables: dict[str, str]) -> None:
    for name in os.environ.keys() - variables.keys():
        del os.environ[name]
    os.environ.update(variables)


def _begin(numbers: Any, count: int, parent: int) -> None:
    """Prepare a process: it ignores Ctrl-C while it has no task."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    ignore_configurations()
    _restrict_processors(numbers.get(), count)
    Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
    _until_exit.enter_context(library_warnings(warn_on_stderr))


def _interruptible(task: Callable[[], Result]) -> Result:
    """Execute a task in this process, which Ctrl-C interrupts."""
    signal.signal(signal.SIGINT, _interrupt_once)
    try:
        return with_error_to_send(task)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _interrupt_once(number: int, frame: object) -> None:
    """Raise KeyboardInterrupt, and ignore further signals while the task stops."""
    del frame
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _restrict_processors(index: int, count: int) -> None:
    """Restrict this process to its share of the processors, so that the threads of the workers do not compete."""
    if hasattr(os, "sched_setaffinity"):
        available = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, available[index % len(available) :: count])


def _exit_with_parent(parent: int) -> None:
    """End this process when its parent has been killed, and so another process has become the parent."""
    while os.getppid() == parent:
        sleep(POLL)
    os._exit(1)
