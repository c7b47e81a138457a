"""Charts of pages: lines, dots and intervals, drawn by Matplotlib as SVG whose text has the colour of the page's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from markupsafe import Markup

from ommatid.figures.saving import COLOURS, log_ticks, new_figure, own_style, svg_text
from ommatid.runtime.printable import printable_label

SIZE = 4.4, 3.4  # inches
LEGEND_ROW = 0.06  # of the height
GREY = "#808080"  # colour 0, legible on light and dark
LOOKS: dict[str, dict[str, Any]] = {
    "line": {"linewidth": 1.6},
    "dashed": {"linewidth": 1.3, "linestyle": "--"},
    "dots": {"linestyle": "none", "marker": "o", "markersize": 5},
    "rings": {"linestyle": "none", "marker": "o", "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 2},
}


@dataclass(frozen=True)
class ChartSeries:
    """Points of a chart: connected by a line, or drawn as dots or rings, with intervals from `low` to `high`, if any.

    name : in the legend, "" for none;  colour : number of a colour, 0 for grey
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    look: Literal["line", "dashed", "dots", "rings"] = "line"
    colour: int = 1
    low: Sequence[float] = ()
    high: Sequence[float] = ()


@dataclass(frozen=True)
class ChartAxis:
    """Label with its unit, scale, and ends; None: as the values ask."""

    label: str
    logarithmic: bool = False
    ends: tuple[float, float] | None = None


@own_style()
def chart(name: str, x: ChartAxis, y: ChartAxis, series: Sequence[ChartSeries], description: str) -> Markup:
    """Return a chart as an SVG element; name : unique on its page;  description : for readers who do not see it."""
    figure = new_figure(*SIZE)
    panel = figure.subplots()
    named = sum(bool(part.name) for part in series)
    figure.subplots_adjust(left=0.16, right=0.96, top=0.97 - LEGEND_ROW * named, bottom=0.15)
    for part in series:
        colour = COLOURS[part.colour - 1] if part.colour else GREY
        if part.low:
            panel.vlines(part.x, part.low, part.high, color=colour, linewidth=5, alpha=0.3)
        panel.plot(part.x, part.y, color=colour, label=printable_label(part.name), **LOOKS[part.look])
    panel.set(xlabel=x.label, ylabel=y.label, xscale=_scale(x), yscale=_scale(y), xlim=x.ends, ylim=y.ends)
    for axis, side in ((x, panel.xaxis), (y, panel.yaxis)):
        if axis.logarithmic:
            log_ticks(side)
    panel.grid(color=GREY, alpha=0.25)
    if named:  # above the panel, where it covers no points
        panel.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(-0.02, 0.99))
    return Markup(svg_text(figure, f"chart-{name}", description))


def _scale(axis: ChartAxis) -> str:
    return "log" if axis.logarithmic else "linear"
