"""A function in a fresh interpreter, and the peak memory of a computation there."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ommatid.bench.cost import reset_peak_memory, resident_memory

ROOT = Path(__file__).parents[2]


def call(function: Callable[..., Any], *arguments: str | int) -> Any:
    """Return the result of a module's function in an interpreter of its own, through JSON."""
    code = (
        f"import json; from {function.__module__} import {function.__name__} as work;"
        f" print(json.dumps(work(*{arguments!r})))"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(ended.stdout.splitlines()[-1])


def memory_of(work: Callable[[], object]) -> tuple[float, float]:
    """Return the gigabytes of this process before `work`, and their peak during it; NaN where they are not reported."""
    gc.collect()
    is_reset = reset_peak_memory()
    before = resident_memory("VmRSS")
    work()
    peak = resident_memory("VmHWM") if is_reset else None
    return (float("nan"), float("nan")) if before is None or peak is None else (before / 1e9, peak / 1e9)
