"""What work costs: seconds, and the most memory that this process held, where the system tells, as Linux does."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, TypeVar

Result = TypeVar("Result")

STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
PEAK = "VmHWM:"


class Cost(NamedTuple):
    """Seconds, and bytes that the process held at its peak, the program itself included; None where nobody tells."""

    seconds: float
    memory: int | None


def measure_cost(work: Callable[[], Result]) -> tuple[Result, Cost]:
    """What some work returns, and what it cost."""
    told = _forget()
    start = perf_counter()
    result = work()
    return result, Cost(perf_counter() - start, _peak() if told else None)


def _forget() -> bool:
    """Let the peak begin anew; whether the system does."""
    try:
        ctypes.CDLL(None).malloc_trim(0)  # what was freed goes back, or it would hide as much of what the work takes
        FORGET.write_text("5", encoding="ascii")
    except (OSError, AttributeError, TypeError):
        return False
    return True


def _peak() -> int | None:
    try:
        lines = STATUS.read_text(encoding="ascii").splitlines()
        return next((1024 * int(line.split()[1]) for line in lines if line.startswith(PEAK)), None)
    except OSError:
        return None
