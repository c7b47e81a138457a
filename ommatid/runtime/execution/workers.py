"""Parallel execution of independent tasks, and the executors of this machine.

A task is a function defined in a module, applied to one item; both are sent as pickles. Results do not depend on which
worker executes a task. Processes belong to one command and use no network. If one dies, so do the others: what is
finished stays.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from itertools import islice
from multiprocessing import get_context, parent_process
from threading import Thread, Timer
from types import ModuleType
from typing import Any, TypeVar

from ..errors import InputError, MachineError
from ..printable import printable
from ..progress import Progress
from .interpreter import ignore_configurations, import_path, python_environment
from .interrupts import interrupt_once
from .library_warnings import library_warnings, warn_on_stderr

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE = 10.0  # seconds to wait for a scheduler that does not answer, for workers, or for a task that is interrupted
ANSWER = 60.0  # seconds to wait for the answer of a scheduler that has answered before, and may be busy
LOST = "the connection to the scheduler was lost; check that it is running, and repeat the command"
DIED = "a process died, maybe for want of memory; finished results stay, repeat the command with fewer --workers"

_until_exit = ExitStack()  # of a worker process


class Workers:
    """An executor, and the number of tasks that it can run at once."""

    def __init__(self, executor: Executor, size: Callable[[], int]) -> None:
        """Send tasks to `executor`, as many at a time as the current `size`, which may change on a cluster."""
        self._executor = executor
        self._size = size

    def each(
        self, function: Callable[[Item], Result], items: Iterable[Item]
    ) -> Generator[tuple[int, Callable[[], Result]]]:
        """Apply `function` to every item, and yield the index of each that has ended, and its result or its error.

        Items are requested only when a worker is free, so that few are in memory. No task waits in a worker's queue:
        the death of a worker counts only against the task that it was running.
        Raises MachineError when processes or the connection are lost, or when no workers are left. Closing the
        generator cancels the tasks that have not begun.
        """
        remaining = enumerate(items)
        pending: dict[Future[Result], int] = {}
        waits_without_workers = 0
        try:
            while True:
                for index, item in islice(remaining, max(0, max(1, self._size()) - len(pending))):
                    pending[self._submitted(function, item)] = index
                if not pending:
                    return
                ended = wait(pending, PATIENCE, FIRST_COMPLETED).done
                waits_without_workers = 0 if ended or self._size() else waits_without_workers + 1
                if waits_without_workers > 1:  # the first time, a worker that died may be restarting
                    raise MachineError("no workers are left; start some and repeat the command")
                for future in sorted(ended, key=lambda each: (_loss(each) is not None, pending[each])):
                    loss = _loss(future)
                    if loss is not None:
                        raise loss
                    yield pending.pop(future), partial(_result, future)
        finally:
            for future in pending:
                future.cancel()

    def _submitted(self, function: Callable[[Item], Result], item: Item) -> Future[Result]:
        """Submit a task; where processes have died it fails as they do, after those that have ended before."""
        try:
            return self._executor.submit(function, item)
        except BrokenExecutor as error:
            failed: Future[Result] = Future()
            failed.set_exception(error)
            return failed

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], progress: Progress, count: int
    ) -> list[Result]:
        """Apply `function` to all `count` items and return the results in their order.

        Raises the first failure and cancels the rest.
        """
        results: dict[int, Result] = {}
        with closing(self.each(function, items)) as tasks:
            for index, result in tasks:
                results[index] = result()
                progress(len(results) / count)
        return [results[index] for index in range(count)]

    def check_versions(self, facts: Callable[[], dict[str, str]]) -> None:
        """Raise InputError if `facts`, such as versions, differ on a worker; on this machine they never do."""
        del facts


def _loss(future: Future[Any]) -> MachineError | None:
    """Return the reason if all that has not ended is lost with this task: connection or processes."""
    if future.cancelled() or isinstance(future.exception(), CancelledError):
        return MachineError(LOST)
    return MachineError(DIED) if isinstance(future.exception(), BrokenExecutor) else None


def _result(future: Future[Result]) -> Result:
    """Return a task's result, or raise its exception. Raises MachineError if no worker of a cluster survived it."""
    try:
        return future.result()
    except Exception as error:
        if isinstance(error, ImportError) or str(error).startswith("Can't get attribute"):  # while unpickling
            raise InputError(
                f"a worker lacks a part of this program ({printable(error, 100)}); install the same version"
                " of ommatid on all machines"
            ) from error
        if type(error).__name__ != "KilledWorker":  # of distributed, which need not be installed
            raise
        raise MachineError(
            "every worker that tried it died; it may need more memory than they have, their logs say more"
        ) from error


def with_error_to_send(task: Callable[[], Result]) -> Result:
    """Execute a task; an error that another process could not be sent becomes a RuntimeError of the same words.

    Pickles lose the words of some errors. Dask does not send one of endless recursion, and waits for it for ever.
    """
    try:
        return task()
    except Exception as error:
        if _is_sent_whole(error):
            raise
        words = f"{type(error).__name__}: {error}"
    raise RuntimeError(words)  # with a traceback of its own


def _is_sent_whole(error: Exception) -> bool:
    with suppress(Exception):
        return str(pickle.loads(pickle.dumps(error))) == str(error) and not isinstance(error, RecursionError)
    return False


class SerialExecutor(Executor):
    """Executes a task when it is submitted."""

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Execute `fn` now."""
        future: Future[Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class ProcessPool(ProcessPoolExecutor):
    """Executor with `count` processes. Shutting down interrupts running tasks."""

    def __init__(self, count: int) -> None:
        """Prepare the processes, which are started when they are needed. Raises MachineError without semaphores."""
        context = get_context("spawn")
        try:
            with _safe_start():
                numbers: Any = context.SimpleQueue()
                super().__init__(count, context, _begin, (numbers, count))
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


def _begin(numbers: Any, count: int) -> None:
    """Prepare a process: it ignores Ctrl-C while it has no task."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    ignore_configurations()
    _restrict_processors(numbers.get(), count)
    Thread(target=_exit_with_parent, daemon=True).start()
    _until_exit.enter_context(library_warnings(warn_on_stderr))


def _interruptible(task: Callable[[], Result]) -> Result:
    """Execute a task in this process, which Ctrl-C interrupts."""
    signal.signal(signal.SIGINT, interrupt_once)
    try:
        return with_error_to_send(task)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _restrict_processors(index: int, count: int) -> None:
    """Restrict this process to its share of the processors, so that the threads of the workers do not compete."""
    if hasattr(os, "sched_setaffinity"):
        available = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, available[index % len(available) :: count])


def _exit_with_parent() -> None:
    """End this process when its parent has been killed."""
    parent = parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
