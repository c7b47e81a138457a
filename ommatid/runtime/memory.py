"""How much memory there is, and the sentence that refuses what does not fit into it before it is asked for."""

from __future__ import annotations

import os
import resource
from pathlib import Path

from .errors import InputError

SMALL = 50_000_000  # bytes, up to which nobody needs to ask


def free_memory() -> int:
    """Bytes that can be had without swapping, and within the process's own limit; else what is built in."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return free if limit == resource.RLIM_INFINITY else max(min(free, limit - _addresses()), 0)


def _addresses() -> int:
    """Bytes of addresses that this process has taken; 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def check_memory(needed: int, what: str, cure: str) -> None:
    """Raise InputError where `what` needs more bytes than are free; `cure` says what to do."""
    if needed <= SMALL:
        return
    free = free_memory()
    if needed > free:
        raise InputError(f"{what} needs {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free; {cure}")
