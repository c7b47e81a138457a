"""Choice of workers: this process, its threads, processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, TypeVar
from urllib.parse import urlsplit

from ..errors import InputError
from .workers import Workers

Result = TypeVar("Result")


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
def worker_pool(scheduler: str = "", count: int | None = None, threads: int = 1) -> Generator[Workers]:
    """Start or connect to workers: the cluster at `scheduler`, or `count` processes, or `threads` of this process.

    A count of 1 is this process. Raises InputError, which names the option, if there is no such cluster.
    """
    check_options(scheduler, count)
    if scheduler:
        from .dask_cluster import cluster_workers

        with cluster_workers(scheduler) as workers:
            yield workers
    elif count is not None and count > 1:
        from .process_pool import ProcessPool

        with ProcessPool(count) as pool:
            yield Workers(pool, lambda: count)
    else:
        with _SerialExecutor() if threads == 1 else ThreadPoolExecutor(threads) as executor:
            yield Workers(executor, lambda: threads)


def check_options(scheduler: str, count: int | None) -> None:
    """Raise InputError if --scheduler contradicts --workers, is not an address, or needs Dask to be installed."""
    if not scheduler:
        return
    if count is not None:
        raise InputError(
            "--scheduler and --workers: expected one of them; the first names a cluster, the second processes here"
        )
    if not _is_address(scheduler):
        raise InputError(f"--scheduler: expected an address such as tcp://192.168.1.5:8786, got '{scheduler}'")
    if find_spec("distributed") is None:
        raise InputError("--scheduler: needs Dask, which is not installed; run: pip install 'ommatid[cluster]'")


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("tcp", "tls") and bool(parts.hostname and parts.port) and not parts.path
    except ValueError:
        return False
