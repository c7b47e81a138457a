"""Workers of this process, of processes here, or of a running Dask cluster, as `--workers` and `--scheduler` say.

Certificates of tls:// are those of Dask's own configuration.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from threading import Thread
from typing import Any, TypeVar
from urllib.parse import urlsplit

from ..errors import InputError, MachineError
from ..printable import printable
from . import workers
from .workers import LOST, ProcessPool, SerialExecutor, Workers, with_error_to_send

Item = TypeVar("Item")
Result = TypeVar("Result")

EXAMPLE = "192.168.1.5:8786"
TLS_FILES = "distributed.comm.tls: ca-file, client.cert and client.key"
SILENT = logging.CRITICAL + 1
_LOGGERS = ("distributed", "distributed.client", "distributed.gc", "tornado", "tornado.application", "asyncio")


@dataclass(frozen=True)
class Cluster:
    """The address of a scheduler."""

    address: str

    def __str__(self) -> str:
        """Name the cluster as messages do."""
        return f"--scheduler {printable(self.address)}"

    def check(self) -> None:
        """Raise InputError if the address is none, or if Dask is not installed."""
        if not _is_address(self.address):
            raise InputError(
                f"--scheduler: expected an address such as tcp://{EXAMPLE}, got '{printable(self.address)}'"
            )
        if find_spec("distributed") is None:
            raise InputError("--scheduler: needs Dask, which is not installed; run: pip install 'ommatid[cluster]'")


@contextmanager
def worker_pool(cluster: Cluster | None = None, count: int | None = None, threads: int = 1) -> Generator[Workers]:
    """Start or connect to workers: those of `cluster`, or `count` processes, or `threads` of this process.

    A count of 1 is this process. Raises InputError, which names the option, if there is no such cluster.
    """
    if cluster is not None:
        with cluster_workers(cluster) as workers:
            yield workers
    elif count is not None and count > 1:
        with ProcessPool(count) as pool:
            yield Workers(pool, lambda: count)
    else:
        with SerialExecutor() if threads == 1 else ThreadPoolExecutor(threads) as executor:
            yield Workers(executor, lambda: threads)


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("tcp", "tls") and bool(parts.hostname and parts.port) and not parts.path
    except ValueError:
        return False


@contextmanager
def cluster_workers(cluster: Cluster) -> Generator[Workers]:
    """Connect to a cluster. Raises InputError if its scheduler does not answer, or if it has no workers."""
    with _settings(), _connected(cluster) as client:
        yield _ClusterWorkers(client, cluster)


class _ClusterWorkers(Workers):
    """Workers whose installations may differ from this one."""

    def __init__(self, client: Any, cluster: Cluster) -> None:
        super().__init__(client.get_executor(pure=False), self._count_threads)
        self._client = client
        self._cluster = cluster
        self._requirement: _Requirement | None = None

    def _count_threads(self) -> int:
        try:
            return sum(_answer(self._client.nthreads, workers.ANSWER).values())
        except OSError as error:
            raise MachineError(LOST) from error

    def check_versions(self, facts: Callable[[], dict[str, str]]) -> None:
        expected = facts()
        try:
            answers: dict[str, Any] = _answer(partial(self._client.run, facts, on_error="return"), workers.ANSWER)
        except TimeoutError as error:
            raise InputError(
                f"{self._cluster}: not all workers answered within {workers.ANSWER:g} s; restart those that hang"
            ) from error
        for worker, answer in answers.items():
            if isinstance(answer, OSError):  # of its connection
                raise MachineError(f"{self._cluster}: the worker {printable(worker)} was lost; repeat the command")
            if isinstance(answer, Exception):
                raise InputError(_unusable(self._cluster, worker, answer))
            _check_same(str(self._cluster), worker, expected, answer)
        self._requirement = _Requirement(str(self._cluster), facts, expected)

    def each(
        self, function: Callable[[Item], Result], items: Iterable[Item]
    ) -> Generator[tuple[int, Callable[[], Result]]]:
        """Apply `function` as `Workers.each`; each task is preceded by the check of its worker."""
        return super().each(partial(_execute, self._requirement, function), items)


def _execute(requirement: _Requirement | None, function: Callable[[Item], Result], item: Item) -> Result:
    """Execute a task on this worker. Raises InputError if the worker differs."""
    if requirement is not None:
        requirement.check()
    return with_error_to_send(partial(function, item))


@dataclass(frozen=True)
class _Requirement:
    """What has to be the same on a worker, also on one that joins the cluster later."""

    cluster: str
    facts: Callable[[], dict[str, str]]
    expected: dict[str, str]

    def check(self) -> None:
        """Raise InputError if this worker differs."""
        from distributed import get_worker

        _check_same(self.cluster, get_worker().address, self.expected, self.facts())


def _check_same(cluster: str, worker: str, expected: dict[str, str], facts: dict[str, str]) -> None:
    """Raise InputError if the facts of a worker are not those expected."""
    different = [
        f"{name} {facts.get(name)}, here {value}" for name, value in expected.items() if facts.get(name) != value
    ]
    if different:
        raise InputError(
            f"{cluster}: results would differ, because the worker {printable(worker)} has"
            f" {printable('; '.join(different), 120)}; install the same versions on all machines"
        )


def _unusable(cluster: Cluster, worker: str, error: Exception) -> str:
    return (
        f"{cluster}: the worker {printable(worker)} cannot work for this program"
        f" ({printable(f'{type(error).__name__}: {error}', 100)}); install the same version of ommatid there"
    )


def _answer(question: Callable[[], Result], patience: float) -> Result:
    """Return what a cluster answers. Raises TimeoutError if it does not: Dask itself would wait without end."""
    answer: Future[Result] = Future()

    def ask() -> None:
        try:
            answer.set_result(question())
        except BaseException as error:  # is raised where the answer is expected
            answer.set_exception(error)

    Thread(target=ask, daemon=True).start()
    return answer.result(patience)


def scratch_folder() -> str | None:
    """Return a Dask worker's own folder, which Dask clears even if the worker is killed; elsewhere None."""
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker().local_directory
    except ValueError:
        return None


@contextmanager
def _connected(cluster: Cluster) -> Generator[Any]:
    """Connect a client to a cluster with at least one worker. Raises InputError."""
    import asyncio

    from distributed import Client

    security = _security(cluster)
    start = partial(Client, cluster.address, security=security, timeout=workers.PATIENCE, set_as_default=False)
    try:
        asyncio.run(_check_scheduler(cluster, security))
        client: Any = _answer(start, 2 * workers.PATIENCE + 1)
    except Exception as error:  # another server at this address may answer anything
        raise InputError(f"{cluster}: {_no_answer(cluster)}") from error
    with closing(client):
        try:
            _answer(partial(client.wait_for_workers, 1, workers.PATIENCE), workers.PATIENCE + 1)
        except TimeoutError as error:
            raise InputError(
                f"{cluster}: the scheduler has no workers; start some with `dask worker {cluster.address}`"
            ) from error
        yield client


def _security(cluster: Cluster) -> Any:
    """Return the certificates of Dask's configuration. Raises InputError where they cannot be used, or are none."""
    from distributed import Security

    security: Any = Security
    try:
        configured = security()
        encrypted = configured.get_connection_args("client").get("ssl_context") is not None
    except (OSError, ValueError) as error:
        raise InputError(f"{cluster}: Dask's configuration names files that cannot be used ({error})") from error
    if cluster.address.startswith("tls://") and not encrypted:
        raise InputError(f"{cluster}: expected certificates in Dask's configuration ({TLS_FILES}), got none")
    return configured


def _no_answer(cluster: Cluster) -> str:
    """Return that there is no connection, and what to do."""
    if cluster.address.startswith("tls://"):
        return "no encrypted scheduler answers there that accepts the certificate; check both, and Dask's configuration"
    return "no scheduler answers there; start one with `dask scheduler`, or correct the address"


async def _check_scheduler(cluster: Cluster, security: Any) -> None:
    """Return if a Dask scheduler answers; at another server's address the client itself would wait forever."""
    import asyncio

    from distributed.comm.core import connect  # pyright: ignore[reportUnknownVariableType]

    options = security.get_connection_args("client")
    connecting: Any = connect(cluster.address, timeout=workers.PATIENCE, **options)  # pyright: ignore[reportUnknownVariableType]
    comm: Any = await asyncio.wait_for(connecting, workers.PATIENCE + 1)
    await comm.close()


@contextmanager
def _settings() -> Generator[None]:
    """Silence Dask's logs and warnings, since errors are reported by exceptions; restore everything afterwards."""
    from dask import config

    environment = dict(os.environ)  # Dask adds variables for its workers
    no_warning = {"distributed.admin.large-graph-warning-threshold": "1 PiB"}  # tasks are sent with all their data
    with config.set(no_warning), warnings.catch_warnings():
        from distributed.versions import VersionMismatchWarning

        warnings.simplefilter("ignore", VersionMismatchWarning)
        loggers = [logging.getLogger(name) for name in _LOGGERS]
        levels = [logger.level for logger in loggers]
        for logger in loggers:
            logger.setLevel(SILENT)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
            for name in os.environ.keys() - environment.keys():
                del os.environ[name]
