"""What our ways to render, to calibrate and to estimate gain, and over what: `python -m tests.benchmarks`.

`python -m tests.benchmarks frames` measures one part alone; the parts are `rendering`, `lenses`,
`leaving-out`, `forms` and `frames`.
Nothing here asserts a speed. Other load slows both sides of a ratio alike, so ratios are to be compared, not times.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from math import isnan
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ommatid.runtime.versions import versions
from ommatid.simulate.renderer.variant import unusable_reason

from .alternation import VARIANTS, Row
from .calibration import PASS, calibration_rows
from .camera import SAMPLES, camera_rows
from .forms import NOISE, form_rows
from .frame_tables import bandwidth_table, frames_table, growth_table
from .leaving_out import SAMPLES as EACH
from .leaving_out import SIDE as WIDE
from .leaving_out import leaving_out_rows
from .lenses import SAMPLES as BUNDLE
from .lenses import SIDE, lens_rows, transport_rows
from .lenses import VARIANT as LENSES

SCENES = Path(__file__).parents[2] / "scenes"
NARROWEST = 160


def main() -> None:
    """Run the benchmarks that are asked for, or every one, and print their tables as they come."""
    names = sys.argv[1:] or list(PARTS)
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise SystemExit(f"{unknown[0]!r} is no part of the benchmarks; expected some of: {', '.join(PARTS)}")
    console = Console()
    console.width = max(console.width, NARROWEST)  # a pipe has 80 columns, which break every cell
    for name in names:
        for table in PARTS[name]():
            console.print(table)


def _rendering() -> Iterator[Table]:
    """Rendering and calibration, on every variant that works here."""
    start = perf_counter()
    found = ", ".join(f"{name} {version}" for name, version in versions("mitsuba", "drjit").items())
    table = Table(title=f"Speed against stock Mitsuba, on {os.cpu_count()} cores with {found}", show_lines=True)
    for name in ("what", "variant", "A", "B", "time of A", "time of B", "B / A", "aim", "same result?"):
        table.add_column(name, no_wrap=name in ("what", "variant", "time of A", "time of B", "B / A"))
    reasons = {variant: unusable_reason(variant) for variant in VARIANTS}
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
    yield table


def _forms() -> Iterator[Table]:
    table = Table(title=f"Work and precision of the estimator's forms, noise variance {NOISE:g}", show_lines=False)
    for name in ("unknowns", "measurements", "lens types", "form", "factorise", "solve", "solve, refine and bound"):
        table.add_column(name, justify="right" if name not in ("lens types", "form") else "left")
    for name in ("digits alone", "digits refined", "digits of the worst variance"):
        table.add_column(name, justify="right")
    before = None
    for row in form_rows(SCENES):
        if before is not None and (row.unknowns, row.lenses) != before:
            table.add_section()
        before = row.unknowns, row.lenses
        what = [str(row.unknowns), str(row.measurements), row.lenses, row.form]
        if row.seconds is None or row.digits is None:
            table.add_row(*what, row.failed)
            continue
        seconds = [f"{value:.2g} s" if value >= 1 else f"{value * 1e3:.3g} ms" for value in row.seconds]
        table.add_row(*what, *seconds, *("reference" if isnan(value) else f"{value:.1f}" for value in row.digits))
    yield table


def _frames() -> Iterator[Table]:
    for table in (frames_table, growth_table, bandwidth_table):
        yield table()


def _lenses() -> Iterator[Table]:
    def rows() -> Iterator[tuple[str, Row]]:
        for row in lens_rows():
            yield f"{SIDE} x {SIDE} pixels\n{BUNDLE} samples a pixel", row
        for row in transport_rows(SCENES / "tile19.toml"):
            yield "calibration: tile19\n1024 samples", row

    yield _compared("Real lenses, and calibration by transport", rows())


def _leaving_out() -> Iterator[Table]:
    what = f"{WIDE} x {WIDE}, three types\n{EACH} samples a pixel"
    yield _compared("What leaving out saves", ((what, row) for row in leaving_out_rows()))


def _compared(title: str, rows: Iterator[tuple[str, Row]]) -> Table:
    """A table of ratios on the fast backend; of what was measured, and the row."""
    table = Table(title=title, show_lines=True)
    for name in ("what", "variant", "A", "B", "time of A", "time of B", "B / A", "aim", "same result?"):
        table.add_column(name, no_wrap=name in ("what", "variant", "time of A", "time of B", "B / A"))
    reason = unusable_reason(LENSES)
    if reason:
        table.caption = f"All was left out: {reason}."
        return table
    for what, row in rows:
        _add(table, what, row)
    return table


PARTS: dict[str, Callable[[], Iterator[Table]]] = {
    "rendering": _rendering,
    "lenses": _lenses,
    "leaving-out": _leaving_out,
    "forms": _forms,
    "frames": _frames,
}


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
