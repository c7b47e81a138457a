"""What our ways to render and to calibrate gain over Mitsuba as it comes: `python -m tests.benchmarks`.

Nothing here asserts a speed. Other load slows both sides of a ratio alike, so ratios are to be compared, not times.
"""

from __future__ import annotations

import os
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from scenes.versions import versions
from simulate.variant import blocked

from .alternation import VARIANTS, Row
from .calibration import PASS, calibration_rows
from .camera import SAMPLES, camera_rows

SCENES = Path(__file__).parents[2] / "scenes"
NARROWEST = 160


def main() -> None:
    """Run every benchmark on every variant that works here, and print one table."""
    start = perf_counter()
    found = ", ".join(f"{name} {version}" for name, version in versions("mitsuba", "drjit").items())
    table = Table(title=f"Speed against stock Mitsuba, on {os.cpu_count()} cores with {found}", show_lines=True)
    for name in ("what", "variant", "A", "B", "time of A", "time of B", "B / A", "aim", "same result?"):
        table.add_column(name, no_wrap=name in ("what", "variant", "time of A", "time of B", "B / A"))
    reasons = {variant: blocked(variant) for variant in VARIANTS}
    working = [variant for variant in VARIANTS if not reasons[variant]]
    for variant in working:
        for samples in SAMPLES:
            for row in camera_rows(SCENES / "tile19.toml", variant, samples):
                _add(table, f"camera: tile19\n{samples} samples a pixel", row)
    for variant in working:
        for row in calibration_rows(SCENES / "photo.toml", variant):
            _add(table, f"calibration: 119 x 119\none pass of {PASS.samples} samples", row)
    skipped = [f"{variant} was left out: {reason}." for variant, reason in reasons.items() if reason]
    table.caption = " ".join(
        [
            "Medians (minimum to maximum of the ratio) over repeats in alternation after a warm-up of each.",
            *skipped,
            f"All of it took {perf_counter() - start:.0f} s.",
        ]
    )
    console = Console()
    console.width = max(console.width, NARROWEST)  # a pipe has 80 columns, which break every cell
    console.print(table)


def _add(table: Table, what: str, row: Row) -> None:
    median, least, most = (f"{value:.3g}" if value < 100 else f"{value:.0f}" for value in _spread(row.ratios))
    table.add_row(
        what,
        row.variant,
        row.ours,
        row.other,
        _time(row.seconds),
        _time(row.other_seconds),
        f"{median} ({least} to {most})\n{row.ratios.size} repeats",
        f"{row.aim:g}" if row.aim is not None else "-",
        row.check,
    )


def _spread(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(np.median(values)), float(values.min()), float(values.max())


def _time(seconds: NDArray[np.float64]) -> str:
    median = float(np.median(seconds))
    if median >= 100:
        return f"{median:.0f} s"
    return f"{median:.1f} s" if median >= 1 else f"{median * 1e3:.0f} ms"


if __name__ == "__main__":
    main()
