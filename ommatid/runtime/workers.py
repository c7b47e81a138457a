"""Workers: an executor and how many pieces of work it takes at a time.

A piece of work is a function that a module defines, and one item; both are sent as pickles. Which worker does which
piece, and how often one dies meanwhile, makes no difference to the results.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from time import monotonic
from typing import Any, Generic, TypeVar

from .errors import MachineError
from .interrupts import interrupts_remembered
from .progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE = 10.0  # seconds, for a scheduler that does not answer, and for a cluster that has no workers
GLANCE = 0.5  # seconds between two looks for a Ctrl-C that was lost
LOST = "the connection to the scheduler was lost; see whether it still runs, and repeat the command"


@dataclass(frozen=True)
class Completed(Generic[Result]):
    """A piece of work that has ended: the place of its item, and what came of it."""

    index: int
    _future: Future[Result]

    def result(self) -> Result:
        """What the function returned, or raised. Raises DeniedError if it could not be done."""
        try:
            return self._future.result()
        except CancelledError as error:
            raise MachineError(LOST) from error
        except Exception as error:
            if type(error).__name__ != "KilledWorker":  # whose module is not there without a cluster
                raise
            raise MachineError(
                "every worker that tried it died; it may need more memory than they have, their logs say more"
            ) from error


class Workers:
    """Those who do the work: what takes in pieces of it, and how many it does at a time."""

    def __init__(self, executor: Executor, hands: Callable[[], int]) -> None:
        """Hand out pieces to `executor`, as many at a time as there are `hands` just then."""
        self._executor = executor
        self._hands = hands

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Completed[Result]]:
        """Do every item, and yield each as it ends, whatever happens to the others.

        An item is asked for when somebody is free for it, so that few are held at a time; and since nobody has a
        piece in reserve, a worker that dies is held against the one piece that it was doing.
        Raises DeniedError when no workers are left. Whoever stops listening cancels what has not begun.
        """
        waiting = enumerate(items)
        pending: dict[Future[Result], int] = {}
        alone = 0
        with interrupts_remembered() as interrupted, _cancelled_at_last(pending):
            while True:
                for place, item in islice(waiting, max(0, max(1, self._hands()) - len(pending))):
                    pending[self._executor.submit(function, item)] = place
                if not pending:
                    return
                ended = _first_of(pending, interrupted)
                alone = 0 if ended or self._hands() else alone + 1  # a worker that died may be back in a moment
                if alone > 1:
                    raise MachineError("no workers are left; start some and repeat the command")
                for future in sorted(ended, key=pending.__getitem__):
                    yield Completed(pending.pop(future), future)

    def check_versions(self, facts: Callable[[], dict[str, str]]) -> None:
        """Raise InputError if a worker answers `facts`, such as versions, otherwise than this process does."""
        del facts  # whoever works in this installation answers the same

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], progress: Progress, count: int
    ) -> list[Result]:
        """What the function makes of all `count` items, in their order.

        Raises the first failure, and cancels the rest.
        """
        results: dict[int, Result] = {}
        with closing(self.each(function, items)) as everything:
            for ended in everything:
                results[ended.index] = ended.result()
                progress(len(results) / count)
        return [results[place] for place in range(count)]


@contextmanager
def _cancelled_at_last(pending: Iterable[Future[Any]]) -> Generator[None]:
    try:
        yield
    finally:
        for future in pending:
            future.cancel()


def _first_of(pending: Iterable[Future[Result]], interrupted: Callable[[], None]) -> set[Future[Result]]:
    """Those that ended first; none after some patience. Raises KeyboardInterrupt even where that was swallowed."""
    until = monotonic() + PATIENCE
    while True:
        ended, _ = wait(pending, max(0.0, min(GLANCE, until - monotonic())), FIRST_COMPLETED)
        interrupted()
        if ended or monotonic() >= until:
            return ended
