"""Benchmarks of rendering, calibration and estimation against other methods: `python -m tests.benchmarks`.

`python -m tests.benchmarks frames` runs one part; the parts are `rendering`, `lenses`, `leaving-out`, `forms`,
`frames`, `film`, which takes ten minutes, and `nasty`, which takes half an hour. No speed is asserted.
`python -m tests.benchmarks coverage` measures error bars instead, for hours, and is run by itself (`coverage --help`).
Other load slows both sides of a ratio alike, so compare ratios rather than times.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from math import isnan
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.versions import versions
from ommatid.simulate.renderer.variant import unusable_reason

from .alternation import VARIANTS, Row
from .calibration import PASS, calibration_rows
from .camera import SAMPLES, camera_rows
from .coverage.command import command as coverage
from .film import film_table
from .forms import NOISE, form_rows
from .frame_tables import bandwidth_table, frames_table, growth_table
from .leaving_out import SAMPLES as LEAVING_OUT_SAMPLES
from .leaving_out import SIDE as LEAVING_OUT_SIDE
from .leaving_out import leaving_out_rows
from .lenses import SAMPLES as LENS_SAMPLES
from .lenses import SIDE as LENS_SIDE
from .lenses import VARIANT as LENS_VARIANT
from .lenses import lens_rows, transport_rows
from .nasty import nasty_table

SCENES = Path(__file__).parents[2] / "scenes"
NARROWEST = 160
COVERAGE = "coverage"


def main() -> None:
    """Run the parts that are named on the command line, or all, and print each table as soon as it is complete."""
    if sys.argv[1:2] == [COVERAGE]:
        coverage(sys.argv[2:])
        return
    names = sys.argv[1:] or list(PARTS)
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise SystemExit(
            f"{unknown[0]!r} is not a part of the benchmarks; expected {COVERAGE}, or some of: {', '.join(PARTS)}"
        )
    console = Console()
    console.width = max(console.width, NARROWEST)  # a pipe has 80 columns, which break every cell
    for name in names:
        for table in PARTS[name]():
            console.print(table)


def _rendering() -> Iterator[Table]:
    """Rendering and calibration, on every variant that works here."""
    start = perf_counter()
    releases = ", ".join(f"{name} {version}" for name, version in versions("mitsuba", "drjit").items())
    table = _ratio_table(f"Speed against stock Mitsuba, on {os.cpu_count()} cores with {releases}")
    reasons = {variant: unusable_reason(variant) for variant in VARIANTS}
    working = [variant for variant in VARIANTS if not reasons[variant]]
    for variant in working:
        for samples in SAMPLES:
            for row in camera_rows(SCENES / "tile19.toml", variant, samples):
                _add(table, f"camera: tile19\n{samples} samples per pixel", row)
    for variant in working:
        for row in calibration_rows(SCENES / "photo.toml", variant):
            _add(table, f"calibration: 119 x 119\none pass of {PASS.samples} samples", row)
    skipped = [f"{variant} was left out: {reason}." for variant, reason in reasons.items() if reason]
    table.caption = " ".join(
        [
            "Medians (minimum to maximum of the ratio) over repeats in alternation after a warm-up of each.",
            *skipped,
            f"Total time: {perf_counter() - start:.0f} s.",
        ]
    )
    yield table


def _forms() -> Iterator[Table]:
    table = Table(title=f"Time and precision of the estimator's forms, noise variance {NOISE:g}", show_lines=False)
    for name in ("unknowns", "measurements", "lens types", "form", "factorise", "solve", "solve, refine and bound"):
        table.add_column(name, justify="right" if name not in ("lens types", "form") else "left")
    for name in ("digits, unrefined", "digits, refined", "digits of the worst variance"):
        table.add_column(name, justify="right")
    previous = None
    for row in form_rows(SCENES):
        if previous is not None and (row.unknowns, row.lenses) != previous:
            table.add_section()
        previous = row.unknowns, row.lenses
        case = [str(row.unknowns), str(row.measurements), row.lenses, row.form]
        if row.seconds is None or row.digits is None:
            table.add_row(*case, row.failed)
            continue
        seconds = [f"{value:.2g} s" if value >= 1 else f"{value * 1e3:.3g} ms" for value in row.seconds]
        table.add_row(*case, *seconds, *("reference" if isnan(value) else f"{value:.1f}" for value in row.digits))
    yield table


def _frames() -> Iterator[Table]:
    for table in (frames_table, growth_table, bandwidth_table):
        yield table()


def _film() -> Iterator[Table]:
    yield film_table()


def _nasty() -> Iterator[Table]:
    yield nasty_table()


def _lenses() -> Iterator[Table]:
    def rows() -> Iterator[tuple[str, Row]]:
        for row in lens_rows():
            yield f"{LENS_SIDE} x {LENS_SIDE} pixels\n{LENS_SAMPLES} samples per pixel", row
        for row in transport_rows(SCENES / "tile19.toml"):
            yield "calibration: tile19\n1024 samples", row

    yield _compared("Lenses with surfaces, and calibration by transport", rows())


def _leaving_out() -> Iterator[Table]:
    case = f"{LEAVING_OUT_SIDE} x {LEAVING_OUT_SIDE}, three types\n{LEAVING_OUT_SAMPLES} samples per pixel"
    yield _compared("Time saved by skipping negligible effects", ((case, row) for row in leaving_out_rows()))


def _compared(title: str, rows: Iterator[tuple[str, Row]]) -> Table:
    """Return a table of ratios on the fast backend, from cases and their rows."""
    table = _ratio_table(title)
    reason = unusable_reason(LENS_VARIANT)
    if reason:
        table.caption = f"Nothing was measured: {reason}."
        return table
    for case, row in rows:
        _add(table, case, row)
    return table


PARTS: dict[str, Callable[[], Iterator[Table]]] = {
    "rendering": _rendering,
    "lenses": _lenses,
    "leaving-out": _leaving_out,
    "forms": _forms,
    "frames": _frames,
    "film": _film,
    "nasty": _nasty,
}


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
