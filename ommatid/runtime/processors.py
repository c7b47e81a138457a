"""How many processors there are for this process, and linear algebra that does not depend on it."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingTypeStubs]


def processors() -> int:
    """Those that this process may run on: all of the machine, or its share of them."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def one_thread() -> Generator[None]:
    """Linear algebra by one thread: with more of them last digits depend on how many there are.

    Also as a decorator.
    """
    import scipy.linalg  # pyright: ignore[reportUnusedImport]  # noqa: F401  # only loaded libraries can be told

    with threadpool_limits(1, "blas"):
        yield
