"""Figures of rows: a column against another, one curve for every group of rows, with the same axes and legends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf
from typing import Any

from ommatid.runtime.study import Row

from .saving import COLOURS

Style = dict[str, Any]  # options of Matplotlib's `plot`

MORE_COLOURS = (*COLOURS, "#7A4F9A", "#555555")
LINES = ("-", "--", ":", "-.")
FRONT: Style = {"color": "0.75", "linewidth": 7, "alpha": 0.6, "solid_capstyle": "round"}


def cycled(number: int, values: Sequence[str]) -> str:
    """Return the value of a number, beginning again after the last."""
    return values[number % len(values)]


def draw_curve(axes: Any, rows: Iterable[Row], x: str, y: str, **style: Any) -> None:
    """Draw column `y` of rows, in their order, against column `x`, with bars where they have `y`_low and `y`_high.

    Rows without either number are left out, and on a logarithmic axis those of 0, which are no points there. NaN is a
    gap in the curve.
    """
    least = 0.0 if axes.get_yscale() == "log" else -inf
    known = [row for row in rows if row.get(x) is not None and row.get(y) is not None and not row[y] <= least]
    if not known:  # which Matplotlib warns of on a logarithmic axis
        return
    across, values = ([row[name] for row in known] for name in (x, y))
    if f"{y}_low" not in known[0]:
        axes.plot(across, values, **style)
        return
    below = [max(row[y] - row[f"{y}_low"], 0.0) for row in known]
    above = [max(row[f"{y}_high"] - row[y], 0.0) for row in known]
    axes.errorbar(across, values, yerr=[below, above], elinewidth=0.8, capsize=1.5, **style)


def label(axes: Any, title: str, x: str, y: str, log: str = "") -> None:
    """Name a panel and its axes, above a light grid; log : "x", "y" or "xy" for logarithmic axes."""
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    for name in log:
        getattr(axes, f"set_{name}scale")("log")
    axes.tick_params(labelleft=True, labelbottom=True)
    axes.grid(visible=True, which="major", color="0.9")
    axes.set_axisbelow(True)


def draw_level(axes: Any, value: float, words: str, side: str = "bottom") -> None:
    """Mark a value along y by a dotted line with its name on the given side."""
    axes.axhline(value, color="0.35", linewidth=1, linestyle=":", zorder=2)
    axes.text(0.01, value, words, transform=axes.get_yaxis_transform(), va=side, fontsize=8, color="0.3")


def legend(place: Any, entries: Iterable[tuple[Style, str]], **options: Any) -> None:
    """Name styles in a legend of a panel or a figure."""
    from matplotlib.lines import Line2D

    known = list(entries)
    handles: list[Any] = [Line2D([], [], **style) for style, _ in known]
    place.legend(handles, [words for _, words in known], **{"fontsize": 9, "title_fontsize": 9, **options})
