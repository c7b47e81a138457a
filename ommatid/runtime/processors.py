"""Number of available processors, age of the process, and linear algebra that does not depend on it."""

from __future__ import annotations

import os
import time
from collections.abc import Generator
from contextlib import contextmanager

import psutil
from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingTypeStubs]


def processors() -> int:
    """Return the number of processors that this process may run on (its CPU affinity)."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def seconds_since_start() -> float:
    """Return the seconds since this process started."""
    return time.time() - psutil.Process().create_time()


@contextmanager
def one_thread() -> Generator[None]:
    """Restrict BLAS to one thread: with several, the last digits depend on their number. Also usable as a decorator."""
    import scipy.linalg  # pyright: ignore[reportUnusedImport]  # noqa: F401  # only loaded libraries can be limited

    with threadpool_limits(1, "blas"):
        yield
