"""The measurements of whole frames as tables."""

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
    """Our frame solver against its rivals."""
    start = perf_counter()
    table = _empty(
        f"A frame of {SIZE} x {SIZE}, noise variance {NOISE:g}, to {ACCURACY:g} posterior standard deviations",
        ("way",),
        ("steps", "time", "time / ours", "aim", "memory", "memory / ours", "aim", "largest error"),
    )
    rows, apart = frame_rows()
    for row in rows:
        if row.memory is None and row.ours is row.seconds:
            table.add_section()
        table.add_row(*_frame_cells(row))
    table.caption = (
        f"Medians (minimum to maximum) of {REPEATS} repeats in alternation. The lower part is against its own first"
        " line. Rivals take the fewest steps that suffice. H itself is stored before, and neither timed"
        " nor counted; memory is what an interpreter of its own needs at its peak above what holds H and g. Errors are"
        f" in posterior standard deviations, against our solver's solution to 1e-6, which is {apart:.1g} from"
        f" Cholesky's. All of it took {perf_counter() - start:.0f} s."
    )
    return table


def _frame_cells(row: FrameRow) -> list[str]:
    ratios = row.seconds / row.ours
    times = f"{np.median(ratios):.3g} ({ratios.min():.3g} to {ratios.max():.3g})"
    memory = ["-", "-", "-"]
    if row.memory is not None and row.ours_memory is not None:
        memory = [_gigabytes(row.memory), f"{row.memory / row.ours_memory:.3g}", _number(row.memory_aim)]
    return [
        row.name,
        _number(row.steps),
        _time(float(np.median(row.seconds))),
        times,
        _number(row.aim),
        *memory,
        f"{row.error:.3g}",
    ]


def growth_table() -> Table:
    """Our frame solver from small frames to large ones."""
    start = perf_counter()
    table = _empty(
        f"Our frame solver as the frame grows, noise variance {NOISE:g}",
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
            f"{row.error / variance:.4f} ({row.surprise:+.1f} s.e.)",
        )
    table.caption = (
        "The fastest of a few repeats, each size in an interpreter of its own, with nothing prepared but what is"
        " compiled; data: the whole process with image and readings alone. Interior: from"
        f" {BORDER} pixels off the border; predicted there: {variance:.4f}."
        f" All of it took {perf_counter() - start:.0f} s."
    )
    return table


def bandwidth_table() -> Table:
    """H and its adjoint against memory."""
    table = _empty(
        f"One application of H of {WIDE} x {WIDE} pixels against the bandwidth of memory",
        ("what",),
        ("must move", "time", "speed", "of the limit"),
    )
    for row in bandwidth_rows():
        table.add_row(
            row.name,
            _gigabytes(row.moved / 1e9),
            _time(float(np.median(row.seconds))),
            f"{row.speed / 1e9:.3g} GB/s",
            f"{row.share:.0%}",
        )
    table.caption = "Medians in alternation, on all cores; the limit is the faster of copy and triad beside it."
    return table


def _empty(title: str, words: tuple[str, ...], numbers: tuple[str, ...]) -> Table:
    table = Table(title=title)
    for name in words:
        table.add_column(name, no_wrap=True)
    for name in numbers:
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
