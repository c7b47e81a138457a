"""Seconds and peak memory of a computation."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import TypeVar

from ommatid.simulate.renderer.variant import release

Result = TypeVar("Result")

STATUS, CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def measured(work: Callable[[], Result]) -> tuple[Result, float, int | None]:
    """Return the result of `work`, its seconds, and its peak memory if the system reports it."""
    release()
    is_reset = reset_peak_memory()
    start = perf_counter()
    result = work()
    return result, perf_counter() - start, resident_memory("VmHWM") if is_reset else None


def reset_peak_memory() -> bool:
    """Reset the peak of the resident memory to its present value; return False where the system cannot.

    The peak comes from /proc and not from getrusage, whose ru_maxrss is inherited from the parent process and cannot
    be reset.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)  # return freed memory, which would hide as much of the work's memory
        CLEAR_REFS.write_text("5", encoding="ascii")
    except (OSError, AttributeError, TypeError):
        return False
    return True


def resident_memory(field: str) -> int | None:
    """Return a field of /proc/self/status in bytes: VmRSS, resident memory, or VmHWM, its peak; None without /proc."""
    try:
        lines = STATUS.read_text(encoding="ascii").splitlines()
        return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), None)
    except OSError:
        return None
