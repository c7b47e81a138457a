"""Benchmarks of rendering and estimation against other methods: `python -m tests.benchmarks`.

`python -m tests.benchmarks frames` runs one part; the parts are `rendering` and `frames`. No speed is asserted, and
other load slows both sides of a ratio alike, so compare ratios rather than times. Run by themselves: `chain`, the time,
memory and files of every stage of a run from 239 x 239 pixels on, and the campaigns, which continue where they were
interrupted: `nasty`, half an hour, and `coverage`, which measures error bars for hours (`coverage --help`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.versions import versions
from ommatid.simulate.renderer.variant import unusable_reason

from .alternation import VARIANTS, Row
from .camera import SAMPLES, camera_rows
from .chain import command as chain
from .coverage.command import command as coverage
from .frames import frames_table
from .nasty import command as nasty

SCENES = Path(__file__).parents[2] / "scenes"
NARROWEST = 160


def main() -> None:
    """Run the parts that are named on the command line, or all, and print each table as soon as it is complete."""
    if sys.argv[1:2] and sys.argv[1] in ALONE:
        ALONE[sys.argv[1]](sys.argv[2:])
        return
    names = sys.argv[1:] or list(PARTS)
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise SystemExit(
            f"{unknown[0]!r} is not a part of the benchmarks; expected one of {', '.join(ALONE)},"
            f" or some of {', '.join(PARTS)}"
        )
    console = Console()
    console.width = max(console.width, NARROWEST)  # a pipe has 80 columns, which break every cell
    for name in names:
        for table in PARTS[name]():
            console.print(table)


def _rendering() -> Iterator[Table]:
    """Rendering, on every variant that works here."""
    start = perf_counter()
    releases = ", ".join(f"{name} {version}" for name, version in versions("mitsuba", "drjit").items())
    table = _ratio_table(f"Rendering speed against stock Mitsuba, on {os.cpu_count()} cores with {releases}")
    reasons = {variant: unusable_reason(variant) for variant in VARIANTS}
    working = [variant for variant in VARIANTS if not reasons[variant]]
    for variant in working:
        for samples in SAMPLES:
            for row in camera_rows(SCENES / "tile19.toml", variant, samples):
                _add(table, f"tile19\n{samples} samples per pixel", row)
    skipped = [f"{variant} was left out: {reason}." for variant, reason in reasons.items() if reason]
    table.caption = " ".join(
        [
            "Medians (minimum to maximum of the ratio) over repeats in alternation after a warm-up of each.",
            *skipped,
            f"Total time: {perf_counter() - start:.0f} s.",
        ]
    )
    yield table


def _frames() -> Iterator[Table]:
    yield frames_table()


PARTS: dict[str, Callable[[], Iterator[Table]]] = {
    "rendering": _rendering,
    "frames": _frames,
}
ALONE: dict[str, Callable[[list[str]], None]] = {"chain": chain, "coverage": coverage, "nasty": nasty}


def _ratio_table(title: str) -> Table:
    table = Table(title=title, show_lines=True)
    for name in ("case", "variant", "A", "B", "time of A", "time of B", "B / A", "target", "difference of the results"):
        table.add_column(name, no_wrap=name in ("case", "variant", "time of A", "time of B", "B / A"))
    return table


def _add(table: Table, case: str, row: Row) -> None:
    ratios = float(np.median(row.ratios)), float(row.ratios.min()), float(row.ratios.max())
    median, least, most = (f"{value:.3g}" if value < 100 else f"{value:.0f}" for value in ratios)
    table.add_row(
        case,
        row.variant,
        row.ours,
        row.other,
        _time(row.seconds),
        _time(row.other_seconds),
        f"{median} ({least} to {most})\n{row.ratios.size} repeats",
        f"{row.target:g}" if row.target is not None else "-",
        row.check,
    )


def _time(seconds: FloatArray) -> str:
    median = float(np.median(seconds))
    if median >= 100:
        return f"{median:.0f} s"
    return f"{median:.1f} s" if median >= 1 else f"{median * 1e3:.0f} ms"


if __name__ == "__main__":
    main()
