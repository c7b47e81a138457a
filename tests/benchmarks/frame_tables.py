"""Tables of the benchmarks of whole frames."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from rich.table import Table

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY

from .bandwidth import SIZE as WIDE
from .bandwidth import bandwidth_rows
from .frames import REPEATS, SIZE, FrameRow, frame_rows
from .growth import BORDER, growth_rows
from .whole import NOISE, predicted


def frames_table() -> Table:
    """Return the frame solver against other solvers."""
    start = perf_counter()
    table = _empty(
        f"A frame of {SIZE} x {SIZE}, noise variance {NOISE:g}, to {ACCURACY:g} posterior standard deviations",
        ("solver",),
        ("steps", "time", "time / ours", "target", "memory", "memory / ours", "target", "largest error"),
    )
    rows, difference = frame_rows()
    for row in rows:
        if row.memory is None and row.ours is row.seconds:
            table.add_section()
        table.add_row(*_frame_cells(row))
    table.caption = (
        f"Medians (minimum to maximum) of {REPEATS} repeats in alternation. The lower part is relative to its own first"
        " line. The other solvers take the fewest steps that suffice. Storing H beforehand is neither timed nor"
        " counted; memory is the peak of a separate interpreter above that with H and g. Errors are in posterior"
        " standard deviations, against our solver's solution to 1e-6, which differs by"
        f" {difference:.1g} from that of Cholesky. Total time: {perf_counter() - start:.0f} s."
    )
    return table


def _frame_cells(row: FrameRow) -> list[str]:
    ratios = row.seconds / row.ours
    times = f"{np.median(ratios):.3g} ({ratios.min():.3g} to {ratios.max():.3g})"
    memory = ["-", "-", "-"]
    if row.memory is not None and row.ours_memory is not None:
        memory = [_gigabytes(row.memory), f"{row.memory / row.ours_memory:.3g}", _number(row.memory_target)]
    return [
        row.name,
        _number(row.steps),
        _time(float(np.median(row.seconds))),
        times,
        _number(row.target),
        *memory,
        f"{row.error:.3g}",
    ]


def growth_table() -> Table:
    """Return the frame solver's cost for frames of increasing size."""
    start = perf_counter()
    table = _empty(
        f"The frame solver for increasing sizes, noise variance {NOISE:g}",
        (),
        ("pixels", "time", "time / (N log N)", "steps", "bound", "data", "peak memory", "interior mse", "/ predicted"),
    )
    rows = growth_rows()
    variance, _ = predicted()
    for row in rows:
        table.add_row(
            f"{row.size} x {row.size}",
            _time(row.seconds),
            f"{row.cost / rows[0].cost:.2f}",
            str(row.steps),
            f"{row.bound:.1g}",
            _gigabytes(row.held),
            _gigabytes(row.peak),
            f"{row.error:.4f}",
            f"{row.error / variance:.4f} ({row.score:+.1f} s.e.)",
        )
    table.caption = (
        "The fastest of a few repeats, each size in a separate interpreter, compiled but without other preparation;"
        " data: the process with image and readings only. Interior: at least"
        f" {BORDER} pixels from the border; predicted there: {variance:.4f}."
        f" Total time: {perf_counter() - start:.0f} s."
    )
    return table


def bandwidth_table() -> Table:
    """Return the memory traffic of H and its adjoint against the bandwidth of memory."""
    table = _empty(
        f"One application of H of {WIDE} x {WIDE} pixels against the bandwidth of memory",
        ("operation",),
        ("must move", "time", "speed", "fraction of the bandwidth"),
    )
    for row in bandwidth_rows():
        table.add_row(
            row.name,
            _gigabytes(row.moved / 1e9),
            _time(float(np.median(row.seconds))),
            f"{row.speed / 1e9:.3g} GB/s",
            f"{row.share:.0%}",
        )
    table.caption = (
        "Medians in alternation, on all cores; the bandwidth is that of the faster of copy and triad in the same run."
    )
    return table


def _empty(title: str, text_columns: tuple[str, ...], number_columns: tuple[str, ...]) -> Table:
    table = Table(title=title)
    for name in text_columns:
        table.add_column(name, no_wrap=True)
    for name in number_columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def _gigabytes(value: float) -> str:
    return f"{value:.3g} GB" if value >= 1 else f"{value * 1e3:.3g} MB"


def _time(seconds: float) -> str:
    if seconds >= 1:
        return f"{seconds:.3g} s"
    return f"{seconds * 1e3:.3g} ms"
