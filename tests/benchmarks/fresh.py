"""A function in a fresh interpreter, and the most memory that a piece of work needs there.

Peaks are read from /proc, not from getrusage, whose ru_maxrss a child inherits from whoever started it, and which
cannot be told to forget what was needed before the work began.
"""

from __future__ import annotations

import ctypes
import gc
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def call(function: Callable[..., Any], *arguments: str | int) -> Any:
    """What a function of a module returns in an interpreter of its own, through JSON."""
    code = (
        f"import json; from {function.__module__} import {function.__name__} as work;"
        f" print(json.dumps(work(*{arguments!r})))"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(ended.stdout.splitlines()[-1])


def memory_of(work: Callable[[], object]) -> tuple[float, float]:
    """Gigabytes that this process held before, and its peak while it worked; not numbers where there is no /proc."""
    if not FORGET.exists():
        work()
        return float("nan"), float("nan")
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed goes back, or it would hide as much of what the work takes
    FORGET.write_text("5")
    held = _status("VmRSS")
    work()
    return held, _status("VmHWM")


def _status(name: str) -> float:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024 / 1e9
