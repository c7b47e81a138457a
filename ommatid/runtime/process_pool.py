"""Workers on this machine: processes that take one piece of work at a time and are replaced when one dies.

Each is a fresh interpreter (a fork would have one thread left of the renderer's) and talks through a pipe with a
thread of this process, which therefore knows of which piece a worker died. None outlives this process. Ctrl-C, which
may reach all of them or this process alone, stops each once, and what is done of its piece is kept.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import traceback
from collections.abc import Callable, Generator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Lock, Thread
from time import monotonic
from typing import Any, TypeVar

from .errors import MachineError

Result = TypeVar("Result")

DEATHS = 2  # of workers: so many may die of one piece of work before it is given up
PATIENCE = 10.0  # seconds for a worker that is asked to stop
GIVEN_UP = "every worker that tried it died; it may need more memory than there is"

_FRESH = multiprocessing.get_context("spawn")


@contextmanager
def processes(count: int) -> Generator[Executor]:
    """`count` processes, each on its share of the processors; whoever leaves stops what they are doing."""
    workers = _Workers(count)
    try:
        yield workers
    finally:
        workers.stop()


class _Workers(Executor):
    """A thread a process: it hands over one piece, and waits for what comes of it."""

    def __init__(self, count: int) -> None:
        self._threads = ThreadPoolExecutor(count, initializer=_leave_interrupts)
        self._idle: SimpleQueue[_Worker] = SimpleQueue()
        self._all = [_Worker(place, count) for place in range(count)]
        for worker in self._all:
            self._idle.put(worker)

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        return self._threads.submit(self._done, partial(fn, *args, **kwargs))

    def _done(self, piece: Callable[[], Result]) -> Result:
        worker = self._idle.get()
        try:
            return worker.do(piece)
        finally:
            self._idle.put(worker)

    def stop(self) -> None:
        """Ask every process to stop, and kill those that do not in time."""
        until = monotonic() + PATIENCE
        for worker in self._all:
            worker.ask_to_stop()
        for worker in self._all:
            worker.end(until)
        self._threads.shutdown(cancel_futures=True)


class _Worker:
    """A process, started when there is something to do for it."""

    def __init__(self, place: int, count: int) -> None:
        """The one in this `place` of `count`."""
        self._share = place, count
        self._lock = Lock()  # on starting and on stopping, which two threads may want at once
        self._process: Any = None
        self._pipe: Any = None
        self._stopped = False

    def do(self, piece: Callable[[], Result]) -> Result:
        """What the piece returns, or raises. Raises DeniedError if it kills every process that tries it."""
        message = pickle.dumps(piece)
        for _ in range(DEATHS + 1):
            pipe = self._started()
            try:
                pipe.send_bytes(message)
                answer = pipe.recv_bytes()
            except (EOFError, OSError):
                self._bury()
                continue
            fine, outcome = pickle.loads(answer)
            if fine:
                return outcome
            raise outcome
        raise MachineError(GIVEN_UP)

    def ask_to_stop(self) -> None:
        """Let the process break off what it is doing; no other is started."""
        with self._lock:
            self._stopped = True
            if self._process is not None and self._process.is_alive():
                os.kill(self._process.pid, signal.SIGINT)

    def end(self, until: float) -> None:
        """Return when the process has ended, which it does by force after `until`."""
        with self._lock:
            if self._process is not None:
                self._process.join(max(0.0, until - monotonic()))
                self._process.kill()
                self._process.join()

    def _started(self) -> Connection:
        with self._lock:
            if self._stopped:
                raise CancelledError
            if self._process is None:
                self._pipe, theirs = _FRESH.Pipe()
                self._process = _FRESH.Process(target=_serve, args=(theirs, *self._share), daemon=True)
                self._process.start()
                theirs.close()  # the process has its own, whose closing is how its death is seen
            return self._pipe

    def _bury(self) -> None:
        """Forget a process that has hung up."""
        with self._lock:
            self._pipe.close()
            self._process.kill()
            self._process.join()
            self._process = None


def _leave_interrupts() -> None:
    """Leave Ctrl-C to the main thread; a process started by this one does not hear it before it can answer."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _serve(pipe: Connection, place: int, count: int) -> None:
    """Do piece after piece until nobody asks any more, or until asked to stop."""
    try:
        signal.signal(signal.SIGINT, _break_off)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        _share_processors(place, count)
        Thread(target=_end_with_parent, daemon=True).start()
        while True:
            signal.signal(signal.SIGINT, _break_off)  # Mitsuba puts it back such that it ends no waiting any more
            pipe.send_bytes(_answer(pipe.recv_bytes()))
    except (EOFError, OSError, KeyboardInterrupt):
        os._exit(0)  # what is worth keeping is kept, and whoever could hear more has left


def _answer(message: bytes) -> bytes:
    try:
        return pickle.dumps((True, pickle.loads(message)()))
    except Exception as error:
        error.add_note("".join(traceback.format_exception(error)))  # where it was, which does not travel with it
        with suppress(Exception):
            return pickle.dumps((False, error))
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))


def _break_off(number: int, frame: object) -> None:
    """Stop once: whoever is stopping already is not to be disturbed."""
    del frame
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def _share_processors(place: int, count: int) -> None:
    """Keep to a share of the processors, or the threads of all would wait for each other's."""
    if hasattr(os, "sched_setaffinity"):
        ours = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, ours[place % len(ours) :: count])


def _end_with_parent() -> None:
    """End when the process that asked for the work has been killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
