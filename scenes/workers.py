"""Where work is done: in this process, one piece after another or in threads, or on the workers of a Dask cluster.

A piece of work is a function that a module defines, and one item; both are sent as pickles. Which worker does which
piece, and how often one dies meanwhile, makes no difference to the results.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from tempfile import TemporaryDirectory
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit

from .errors import DeniedError, InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE = 10.0  # seconds, for a scheduler that does not answer, and for a cluster that has no workers
DEATHS = 2  # of workers on this machine: so many may die of one piece of work before it is given up
NEVER = logging.CRITICAL + 1
SHARERS = "ommatid.sharers"  # in Dask's configuration, which its workers are given
LOST = "the connection to the scheduler was lost; see whether it still runs, and repeat the command"
_LOGS = ("distributed", "distributed.client", "distributed.gc", "tornado", "tornado.application", "asyncio")


@dataclass(frozen=True)
class Ended(Generic[Result]):
    """A piece of work that has ended: the place of its item, and what came of it."""

    place: int
    _future: Future[Result]

    def result(self) -> Result:
        """What the function returned, or raised. Raises DeniedError if it could not be done."""
        try:
            return self._future.result()
        except CancelledError as error:
            raise DeniedError(LOST) from error
        except Exception as error:
            if type(error).__name__ != "KilledWorker":  # whose module is not there without a cluster
                raise
            raise DeniedError(
                "every worker that tried it died; it may need more memory than they have, their logs say more"
            ) from error


class Workers:
    """Those who do the work: what takes in pieces of it, and how many it does at a time."""

    def __init__(self, executor: Executor, hands: Callable[[], int]) -> None:
        """Hand out pieces to `executor`, as many at a time as there are `hands` just then."""
        self._executor = executor
        self._hands = hands

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Ended[Result]]:
        """Do every item, and yield each as it ends, whatever happens to the others.

        An item is asked for when somebody is free for it, so that few are held at a time; and since nobody has a
        piece in reserve, a worker that dies is held against the one piece that it was doing.
        Raises DeniedError when no workers are left. Whoever stops listening cancels what has not begun.
        """
        waiting = enumerate(items)
        pending: dict[Future[Result], int] = {}
        alone = 0
        try:
            while True:
                for place, item in islice(waiting, max(0, max(1, self._hands()) - len(pending))):
                    pending[self._executor.submit(function, item)] = place
                if not pending:
                    return
                ended, _ = wait(pending, PATIENCE, FIRST_COMPLETED)
                alone = 0 if ended or self._hands() else alone + 1  # a worker that died may be back in a moment
                if alone > 1:
                    raise DeniedError("no workers are left; start some and repeat the command")
                for future in sorted(ended, key=pending.__getitem__):
                    yield Ended(pending.pop(future), future)
        finally:
            for future in pending:
                future.cancel()

    def refuse_differences(self, facts: Callable[[], dict[str, str]]) -> None:
        """Raise InputError if a worker answers `facts`, such as versions, otherwise than this process does."""
        del facts  # whoever works in this installation answers the same

    def map(
        self, function: Callable[[Item], Result], items: Sequence[Item], progress: Callable[[float], None]
    ) -> list[Result]:
        """What the function makes of every item, in their order. Raises the first failure, and cancels the rest."""
        results: dict[int, Result] = {}
        with closing(self.each(function, items)) as everything:
            for ended in everything:
                results[ended.place] = ended.result()
                progress(len(results) / len(items))
        return [results[place] for place in range(len(items))]


class _Remote(Workers):
    """Those of a cluster somewhere else, whose libraries may be other ones."""

    def __init__(self, client: Any, address: str) -> None:
        super().__init__(*_employed(client))
        self._client = client
        self._address = address

    def refuse_differences(self, facts: Callable[[], dict[str, str]]) -> None:
        ours = facts()
        found: dict[str, dict[str, str] | Exception] = self._client.run(facts, on_error="return")
        for worker, theirs in found.items():
            if isinstance(theirs, Exception):
                raise InputError(
                    f"--scheduler {self._address}: the worker {worker} cannot work for this program"
                    f" ({type(theirs).__name__}: {theirs}); install the same version of ommatid there"
                )
            wrong = [
                f"{name} {theirs.get(name)}, here {value}" for name, value in ours.items() if theirs.get(name) != value
            ]
            if wrong:
                raise InputError(
                    f"--scheduler {self._address}: results would differ, for the worker {worker} has"
                    f" {'; '.join(wrong)}; make them the same on all machines"
                )


def in_process() -> Workers:
    """Whoever does everything here, one item after another, and needs no context to begin and end in."""
    return Workers(_Serial(), lambda: 1)


@contextmanager
def workers(scheduler: str = "", count: int | None = None, threads: int = 1) -> Generator[Workers]:
    """Workers of the cluster at `scheduler`, or `count` processes on this machine, or `threads` in this process.

    A process has one thread for linear algebra, as Dask gives its workers, unless OPENBLAS_NUM_THREADS says otherwise;
    its last digits are those of this process where that has as many threads.
    Raises InputError that names the option if there is no such cluster.
    """
    refuse_options(scheduler, count)
    with ExitStack() as stack:
        if scheduler:
            stack.enter_context(_settings())
            yield _Remote(stack.enter_context(_connected(scheduler)), scheduler)
        elif count is not None:
            stack.enter_context(_settings())
            yield Workers(*_employed(stack.enter_context(_local(count))))
        else:
            yield Workers(
                stack.enter_context(_Serial() if threads == 1 else ThreadPoolExecutor(threads)), lambda: threads
            )


def refuse_options(scheduler: str, count: int | None) -> None:
    """Raise InputError if the options contradict each other, are no address, or need what is not installed."""
    if not scheduler and count is None:
        return
    if scheduler and count is not None:
        raise InputError(
            "--scheduler and --workers: expected one of them; the first names a cluster, the second starts one here"
        )
    if scheduler and not _is_address(scheduler):
        raise InputError(f"--scheduler: expected an address such as tcp://192.168.1.5:8786, got '{scheduler}'")
    if find_spec("distributed") is None:
        option = "--scheduler" if scheduler else "--workers"
        raise InputError(f"{option}: needs Dask, which is not installed; run: pip install 'ommatid[cluster]'")


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("tcp", "tls") and bool(parts.hostname and parts.port) and not parts.path
    except ValueError:
        return False


def scratch() -> str | None:
    """On a worker, its own folder, which Dask clears even after the worker was killed; elsewhere None."""
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker().local_directory
    except ValueError:
        return None


def dask_setup(worker: Any) -> None:
    """What a worker on this machine does first (Dask looks for this name).

    Ctrl-C is for the command, not for it. And it keeps to its share of the processors, or the threads with which each
    renders would wait for each other's.
    """
    from dask import config

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _silence()
    if hasattr(os, "sched_setaffinity"):
        settings: Any = config
        processors = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, processors[worker.name % len(processors) :: settings.get(SHARERS)])


class _Serial(Executor):
    """Does what is submitted there and then."""

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        future: Future[Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _employed(client: Any) -> tuple[Executor, Callable[[], int]]:
    def hands() -> int:
        try:
            return sum(client.nthreads().values())
        except OSError as error:
            raise DeniedError(LOST) from error

    return client.get_executor(pure=False), hands


@contextmanager
def _connected(address: str) -> Generator[Any]:
    """A client of the cluster at `address`, which has at least one worker. Raises InputError."""
    from distributed import Client

    try:
        asyncio.run(_answered(address))
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # what else listens there may answer anything
        raise InputError(
            f"--scheduler {address}: no scheduler answers there; start one with `dask scheduler`, or mend the address"
        ) from error
    with closing(client):
        try:
            client.wait_for_workers(1, PATIENCE)
        except TimeoutError as error:
            raise InputError(
                f"--scheduler {address}: the scheduler has no workers; start some with `dask worker {address}`"
            ) from error
        yield client


async def _answered(address: str) -> None:
    """Return if a Dask scheduler answers; the client itself would wait forever for whatever else listens there."""
    from distributed import Security
    from distributed.comm.core import connect  # pyright: ignore[reportUnknownVariableType]

    security: Any = Security()  # with the certificates that Dask's configuration names, for tls://
    options = security.get_connection_args("client")
    reached: Any = connect(address, timeout=PATIENCE, **options)  # pyright: ignore[reportUnknownVariableType]
    comm: Any = await asyncio.wait_for(reached, PATIENCE + 1)
    await comm.close()


@contextmanager
def _local(count: int) -> Generator[Any]:
    """A client of `count` processes with one thread each, which nobody outside this machine can reach."""
    from dask import config
    from distributed import Client, LocalCluster

    start: Any = LocalCluster
    with (
        TemporaryDirectory(prefix="ommatid-") as folder,
        config.set({"temporary-directory": folder, SHARERS: count}),
        start(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # None would ask for the port 8787, and complain if it is taken
            scheduler_kwargs={"dashboard": False, "allowed_failures": DEATHS},
            memory_limit=0,
            preload=[__name__],
            silence_logs=NEVER,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def _settings() -> Generator[None]:
    """Dask as we need it, and nothing of it on stderr: what goes wrong reaches the user as one sentence."""
    from dask import config

    environment = dict(os.environ)  # to which Dask adds what its workers shall find there
    whole = {"distributed.admin.large-graph-warning-threshold": "1 PiB"}  # a piece travels with all that it needs
    with config.set(whole), warnings.catch_warnings():
        from distributed.versions import VersionMismatchWarning

        warnings.simplefilter("ignore", VersionMismatchWarning)
        levels = _silence()
        try:
            yield
        finally:
            for name, level in levels.items():
                logging.getLogger(name).setLevel(level)
            for name in os.environ.keys() - environment.keys():
                del os.environ[name]


def _silence() -> dict[str, int]:
    """Make the libraries' logs say nothing; their levels before."""
    levels = {name: logging.getLogger(name).level for name in _LOGS}
    for name in levels:
        logging.getLogger(name).setLevel(NEVER)
    return levels
