"""Workers of this machine: this process, its threads, or a pool of processes that replaces dead ones.

`worker_pool` chooses between these and a Dask cluster. Each worker of the pool is a fresh interpreter (a fork would
keep only one of the renderer's threads) that runs one task at a time on its own share of the processors. A thread of
this process talks to it through a pipe, and so knows which task a worker died of. Ctrl-C may reach all processes or
only this one; it interrupts every worker once, and unfinished tasks save their checkpoints. No worker outlives this
process.

Executors of libraries do not fit: concurrent.futures and loky abort all tasks when one worker dies; pebble ignores
Ctrl-C in workers, ends them with SIGTERM, repeats no task, and gives a worker no number to choose its processors by.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import traceback
from collections.abc import Callable, Generator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue
from threading import Lock, Thread
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, TypeVar

from ..errors import InputError, MachineError
from .interpreter import python_command, python_environment
from .library_warnings import library_warnings, warn_on_stderr
from .workers import Workers

if TYPE_CHECKING:
    from .cluster import Cluster

Result = TypeVar("Result")

ATTEMPTS = 3  # workers that may die of a task before it is given up
PATIENCE = 10.0  # seconds for a worker to stop after it was interrupted
POLL = 1.0  # seconds between two checks of a worker for its parent
GIVEN_UP = "every worker that tried it died; it may need more memory than there is"

_SERVE = "from ommatid.runtime.execution.pool import serve; serve(*map(int, sys.argv[1:]))"


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


class ProcessPool(Executor):
    """Executor with `count` worker processes, each started for its first task. Shutting down interrupts running tasks.

    Each thread takes an idle worker, gives it one task, and waits for the answer.
    """

    def __init__(self, count: int) -> None:
        """Start the threads; processes are started when they are needed."""
        self._threads = ThreadPoolExecutor(count, initializer=_block_interrupts)
        self._workers = [_Worker(index, count) for index in range(count)]
        self._idle: SimpleQueue[_Worker] = SimpleQueue()
        for worker in self._workers:
            self._idle.put(worker)

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Execute `fn` in an idle process; its future fails with MachineError if no process survives the task."""
        return self._threads.submit(self._execute, partial(fn, *args, **kwargs))

    def _execute(self, task: Callable[[], Result]) -> Result:
        worker = self._idle.get()
        try:
            return worker.execute(task)
        finally:
            self._idle.put(worker)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Interrupt every process, and kill those that do not stop in time."""
        del wait, cancel_futures
        until = monotonic() + PATIENCE
        for worker in self._workers:
            worker.interrupt()
        for worker in self._workers:
            worker.join(until)
        self._threads.shutdown(cancel_futures=True)


class _Worker:
    """Worker `index` of `count`: a process that is started when there is a task for it."""

    def __init__(self, index: int, count: int) -> None:
        self._share = index, count
        self._lock = Lock()  # for starting and stopping, which two threads may request at once
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Any = None
        self._stopped = False

    def execute(self, task: Callable[[], Result]) -> Result:
        """Return the task's result, or raise its exception. Raises MachineError if it kills every process."""
        message = pickle.dumps(task)
        for _ in range(ATTEMPTS):
            pipe = self._started()
            try:
                pipe.send_bytes(message)
                answer = pipe.recv_bytes()
            except (EOFError, OSError):
                self._discard()
                continue
            succeeded, outcome = pickle.loads(answer)
            if succeeded:
                return outcome
            raise outcome
        raise MachineError(GIVEN_UP)

    def interrupt(self) -> None:
        """Interrupt the running task; start no other process."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.send_signal(signal.SIGINT)  # not sent if it has ended

    def join(self, until: float) -> None:
        """Wait for the process to end; kill it after `until`."""
        with self._lock:
            if self._process is not None:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(max(0.0, until - monotonic()))
                self._process.kill()
                self._process.wait()
                self._pipe.close()

    def _started(self) -> Connection:
        with self._lock:
            if self._stopped:
                raise CancelledError
            if self._process is None:
                self._pipe, other_end = Pipe()
                with other_end:  # leaves the worker's own copy, whose closing shows its death
                    self._process = _start_process(other_end.fileno(), *self._share)
            return self._pipe

    def _discard(self) -> None:
        """Terminate a process that has closed its pipe."""
        with self._lock:
            self._pipe.close()
            if self._process is not None:
                self._process.kill()
                self._process.wait()
            self._process = None


def _block_interrupts() -> None:
    """Leave Ctrl-C to the main thread; a process started by this thread ignores it until its handler is installed."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _start_process(descriptor: int, index: int, count: int) -> subprocess.Popen[bytes]:
    """Start worker `index` of `count`, which talks to the pipe of `descriptor`.

    multiprocessing starts processes that import from the current folder, and run the main script of a user again.
    """
    numbers = map(str, (descriptor, os.getpid(), index, count))
    command = python_command(_SERVE, *numbers)
    return subprocess.Popen(command, env=python_environment(), stdin=subprocess.DEVNULL, pass_fds=[descriptor])


def serve(descriptor: int, parent: int, index: int, count: int) -> None:
    """Run the worker process: execute tasks until the pipe is closed or Ctrl-C arrives."""
    pipe = Connection(descriptor)
    try:
        signal.signal(signal.SIGINT, _interrupt_once)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        _restrict_processors(index, count)
        Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
        with library_warnings(warn_on_stderr):
            while True:
                signal.signal(signal.SIGINT, _interrupt_once)  # Mitsuba resets it to one that interrupts no waiting
                pipe.send_bytes(_answer(pipe.recv_bytes()))
    except (EOFError, OSError, KeyboardInterrupt):
        os._exit(0)  # checkpoints are saved, and the pipe has no reader


def _answer(message: bytes) -> bytes:
    try:
        return pickle.dumps((True, pickle.loads(message)()))
    except Exception as error:
        error.add_note("".join(traceback.format_exception(error)))  # pickles lose the traceback
        with suppress(Exception):
            return pickle.dumps((False, error))
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))


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
