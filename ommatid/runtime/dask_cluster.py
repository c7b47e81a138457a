"""Workers of a Dask cluster that somebody else started, on this machine or elsewhere."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
import warnings
from collections.abc import Callable, Generator
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from typing import Any

from . import workers
from .errors import InputError, MachineError
from .workers import LOST, Workers

NEVER = logging.CRITICAL + 1
_LOGS = ("distributed", "distributed.client", "distributed.gc", "tornado", "tornado.application", "asyncio")


@contextmanager
def cluster_workers(address: str) -> Generator[Workers]:
    """The workers of the cluster whose scheduler is at `address`. Raises InputError if there are none."""
    with _settings(), _connected(address) as client:
        yield _ClusterWorkers(client, address)


class _ClusterWorkers(Workers):
    """Those of a cluster somewhere else, whose libraries may be other ones."""

    def __init__(self, client: Any, address: str) -> None:
        super().__init__(*_employed(client))
        self._client = client
        self._address = address

    def check_versions(self, facts: Callable[[], dict[str, str]]) -> None:
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


def scratch_folder() -> str | None:
    """On a worker, its own folder, which Dask clears even after the worker was killed; elsewhere None."""
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker().local_directory
    except ValueError:
        return None


def _employed(client: Any) -> tuple[Executor, Callable[[], int]]:
    def hands() -> int:
        try:
            return sum(client.nthreads().values())
        except OSError as error:
            raise MachineError(LOST) from error

    return client.get_executor(pure=False), hands


@contextmanager
def _connected(address: str) -> Generator[Any]:
    """A client of the cluster at `address`, which has at least one worker. Raises InputError."""
    from distributed import Client

    try:
        asyncio.run(_answered(address))
        client = Client(address, timeout=workers.PATIENCE, set_as_default=False)
    except Exception as error:  # what else listens there may answer anything
        raise InputError(
            f"--scheduler {address}: no scheduler answers there; start one with `dask scheduler`, or mend the address"
        ) from error
    with closing(client):
        try:
            client.wait_for_workers(1, workers.PATIENCE)
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
    reached: Any = connect(address, timeout=workers.PATIENCE, **options)  # pyright: ignore[reportUnknownVariableType]
    comm: Any = await asyncio.wait_for(reached, workers.PATIENCE + 1)
    await comm.close()


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
