"""Available memory, and the check of a computation's demand before it allocates anything."""

from __future__ import annotations

import resource

from .errors import InputError

SMALL = 50_000_000  # bytes; smaller demands are not checked


def free_memory() -> int:
    """Return the bytes that this process can allocate without swapping, within its address-space limit (ulimit -v)."""
    import psutil

    free = int(psutil.virtual_memory().available)
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return free
    return max(min(free, limit - int(psutil.Process().memory_info().vms)), 0)


def check_memory(needed: int, what: str, cure: str) -> None:
    """Raise InputError if `what` needs more bytes than are free; the message ends with `cure`, the advice."""
    if needed <= SMALL:
        return
    free = free_memory()
    if needed > free:
        raise InputError(f"{what} needs {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free; {cure}")
