"""Choice of workers: this process, its threads, processes of this machine, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from ..errors import InputError
from .cluster import Cluster
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
def worker_pool(cluster: Cluster | None = None, count: int | None = None, threads: int = 1) -> Generator[Workers]:
    """Start or connect to workers: those of `cluster`, or `count` processes, or `threads` of this process.

    A count of 1 is this process. Raises InputError, which names the option, if there is no such cluster.
    """
    check_options(cluster, count)
    if cluster is not None:
        from .dask_cluster import cluster_workers

        with cluster_workers(cluster) as workers:
            yield workers
    elif count is not None and count > 1:
        from .process_pool import ProcessPool

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
