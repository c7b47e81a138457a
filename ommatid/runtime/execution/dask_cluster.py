"""Workers of a running Dask cluster, on this machine or others."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
import warnings
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager
from typing import Any

from ..errors import InputError, MachineError
from . import workers
from .workers import LOST, Workers

SILENT = logging.CRITICAL + 1
_LOGGERS = ("distributed", "distributed.client", "distributed.gc", "tornado", "tornado.application", "asyncio")


@contextmanager
def cluster_workers(address: str) -> Generator[Workers]:
    """Connect to the cluster whose scheduler is at `address`. Raises InputError if it does not answer or is empty."""
    with _settings(), _connected(address) as client:
        yield _ClusterWorkers(client, address)


class _ClusterWorkers(Workers):
    """Workers whose installations may differ from this one."""

    def __init__(self, client: Any, address: str) -> None:
        super().__init__(client.get_executor(pure=False), self._count_threads)
        self._client = client
        self._address = address

    def _count_threads(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise MachineError(LOST) from error

    def check_versions(self, facts: Callable[[], dict[str, str]]) -> None:
        expected = facts()
        answers: dict[str, dict[str, str] | Exception] = self._client.run(facts, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, Exception):
                raise InputError(
                    f"--scheduler {self._address}: the worker {worker} cannot work for this program"
                    f" ({type(answer).__name__}: {answer}); install the same version of ommatid there"
                )
            different = [
                f"{name} {answer.get(name)}, here {value}"
                for name, value in expected.items()
                if answer.get(name) != value
            ]
            if different:
                raise InputError(
                    f"--scheduler {self._address}: results would differ, because the worker {worker} has"
                    f" {'; '.join(different)}; install the same versions on all machines"
                )


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
def _connected(address: str) -> Generator[Any]:
    """Connect a client to a cluster with at least one worker. Raises InputError."""
    from distributed import Client

    try:
        asyncio.run(_check_scheduler(address))
        client = Client(address, timeout=workers.PATIENCE, set_as_default=False)
    except Exception as error:  # another server at this address may answer anything
        raise InputError(
            f"--scheduler {address}: no scheduler answers there; start one with `dask scheduler`,"
            " or correct the address"
        ) from error
    with closing(client):
        try:
            client.wait_for_workers(1, workers.PATIENCE)
        except TimeoutError as error:
            raise InputError(
                f"--scheduler {address}: the scheduler has no workers; start some with `dask worker {address}`"
            ) from error
        yield client


async def _check_scheduler(address: str) -> None:
    """Return if a Dask scheduler answers; at another server's address the client itself would wait forever."""
    from distributed import Security
    from distributed.comm.core import connect  # pyright: ignore[reportUnknownVariableType]

    security: Any = Security()  # for tls://, with the certificates of Dask's configuration
    options = security.get_connection_args("client")
    connecting: Any = connect(address, timeout=workers.PATIENCE, **options)  # pyright: ignore[reportUnknownVariableType]
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
