"""Parallel execution of independent tasks.

A task is a function defined in a module, applied to one item; both are sent as pickles. Results do not depend on which
worker executes a task.
"""

from __future__ import annotations

import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from time import monotonic
from typing import Any, Generic, TypeVar

from ..errors import InputError, MachineError
from ..printable import printable
from ..progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE = 10.0  # seconds to wait for a scheduler that does not answer, or for a cluster without workers
ANSWER = 60.0  # seconds to wait for the answer of a scheduler that has answered before, and may be busy
POLL = 0.5  # seconds between two checks for a dropped Ctrl-C
LOST = "the connection to the scheduler was lost; check that it is running, and repeat the command"
DIED = "a process died, maybe for want of memory; finished results stay, repeat the command with fewer --workers"


@dataclass(frozen=True)
class Completed(Generic[Result]):
    """A task that has ended, with the index of its item."""

    index: int
    _future: Future[Result]

    @property
    def loss(self) -> MachineError | None:
        """Return the reason if all that has not ended is lost with this task: connection or processes."""
        if self._future.cancelled() or isinstance(self._future.exception(), CancelledError):
            return MachineError(LOST)
        return MachineError(DIED) if isinstance(self._future.exception(), BrokenExecutor) else None

    def result(self) -> Result:
        """Return the function's result, or raise its exception. Raises MachineError if no worker survived it."""
        if self.loss is not None:
            raise self.loss
        try:
            return self._future.result()
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


class Workers:
    """An executor, and the number of tasks that it can run at once."""

    def __init__(self, executor: Executor, size: Callable[[], int]) -> None:
        """Send tasks to `executor`, as many at a time as the current `size`, which may change on a cluster."""
        self._executor = executor
        self._size = size

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Completed[Result]]:
        """Apply `function` to every item, and yield each task as it ends, whether it succeeded or failed.

        Items are requested only when a worker is free, so that few are in memory. No task waits in a worker's queue:
        the death of a worker counts only against the task that it was running.
        Raises MachineError when no workers are left. Closing the generator cancels the tasks that have not begun.
        """
        remaining = enumerate(items)
        pending: dict[Future[Result], int] = {}
        waits_without_workers = 0
        with interrupts_remembered() as check_interrupt, _cancelling(pending):
            while True:
                for index, item in islice(remaining, max(0, max(1, self._size()) - len(pending))):
                    pending[self._submit(function, item)] = index
                if not pending:
                    return
                ended = _first_completed(pending, check_interrupt)
                waits_without_workers = 0 if ended or self._size() else waits_without_workers + 1
                if waits_without_workers > 1:  # the first time, a worker that died may be restarting
                    raise MachineError("no workers are left; start some and repeat the command")
                for future in sorted(ended, key=pending.__getitem__):
                    yield Completed(pending.pop(future), future)

    def _submit(self, function: Callable[[Item], Result], item: Item) -> Future[Result]:
        try:
            return self._executor.submit(function, item)
        except BrokenExecutor as error:
            raise MachineError(DIED) from error

    def check_versions(self, facts: Callable[[], dict[str, str]]) -> None:
        """Raise InputError if `facts`, such as versions, differ on a worker; on this machine they never do."""
        del facts

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], progress: Progress, count: int
    ) -> list[Result]:
        """Apply `function` to all `count` items and return the results in their order.

        Raises the first failure and cancels the rest.
        """
        results: dict[int, Result] = {}
        with closing(self.each(function, items)) as tasks:
            for task in tasks:
                results[task.index] = task.result()
                progress(len(results) / count)
        return [results[index] for index in range(count)]


@contextmanager
def _cancelling(pending: Iterable[Future[Any]]) -> Generator[None]:
    try:
        yield
    finally:
        for future in pending:
            future.cancel()


def _first_completed(pending: Iterable[Future[Result]], check_interrupt: Callable[[], None]) -> set[Future[Result]]:
    """Wait for at least one future, at most PATIENCE seconds. Raises KeyboardInterrupt."""
    until = monotonic() + PATIENCE
    while True:
        ended, _ = wait(pending, max(0.0, min(POLL, until - monotonic())), FIRST_COMPLETED)
        check_interrupt()
        if ended or monotonic() >= until:
            return ended


@contextmanager
def interrupts_remembered() -> Generator[Callable[[], None]]:
    """Yield a function that raises KeyboardInterrupt if Ctrl-C was pressed inside, even if the exception was dropped.

    Python raises it in whatever code the main thread is running. In a callback of the garbage collector or in a
    `__del__` method it is printed and dropped, and the command would continue.
    Signals reach the main thread only; in other threads the function does nothing.
    """
    previous = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(previous):
        yield lambda: None
        return
    interrupted = False

    def remember(number: int, frame: object) -> None:
        nonlocal interrupted
        interrupted = True
        previous(number, frame)  # type: ignore[arg-type]

    def check() -> None:
        if interrupted:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, remember)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, previous)
