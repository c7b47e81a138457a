"""What the machine gives this process, processors, memory and time, and linear algebra that does not depend on it."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import psutil
from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingTypeStubs]

from .errors import InputError

SMALL = 50_000_000  # bytes of memory; smaller demands are not checked
START_TIME = 19  # position in /proc/self/stat after the name of the program: ticks from the start of the machine


def processors() -> int:
    """Return the number of processors that this process may run on (its CPU affinity)."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def seconds_since_start() -> float:
    """Return the seconds since this process started, by clocks that are never set back where there are such."""
    try:
        started = int(Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[START_TIME])
        return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - started / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, AttributeError, IndexError):  # not on Linux
        return max(0.0, time.time() - psutil.Process().create_time())


@contextmanager
def one_thread() -> Generator[None]:
    """Restrict BLAS to one thread: with several, the last digits depend on their number. Also usable as a decorator."""
    import scipy.linalg  # pyright: ignore[reportUnusedImport]  # noqa: F401  # only loaded libraries can be limited

    with threadpool_limits(1, "blas"):
        yield


def free_memory() -> int:
    """Return the bytes that this process can allocate without swapping, within its address-space limit (ulimit -v)."""
    free = int(psutil.virtual_memory().available)
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return free
    return max(min(free, limit - int(psutil.Process().memory_info().vms)), 0)


def used_memory() -> int:
    """Return the bytes that this process has, of address space where that is limited."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = psutil.Process().memory_info()
    return int(used.rss if limit == resource.RLIM_INFINITY else used.vms)


def check_memory(needed: int, what: str, cure: str) -> None:
    """Raise InputError if `what` needs more bytes than are free; the message ends with `cure`, the advice."""
    if needed <= SMALL:
        return
    free = free_memory()
    if needed > free:
        raise InputError(f"{what} needs {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free; {cure}")
