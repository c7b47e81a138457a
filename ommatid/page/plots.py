"""Bokeh's figures as a page needs them; the only module of the page that imports Bokeh.

A figure fills the element `plot-NAME`, whose height the page's style sheet gives it: borders are fixed, so that it
knows what is left for square pixels. Colours of axes and text are set in the browser, light or dark.
"""

# pyright: basic
from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bokeh import palettes
from bokeh.document import Document
from bokeh.models import (
    BasicTicker,
    ColorBar,
    ColumnDataSource,
    CrosshairTool,
    CustomJSHover,
    HoverTool,
    LinearColorMapper,
    PanTool,
    Range1d,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure
from bokeh.resources import Resources

Tips = list[tuple[str, str]]

GREY = tuple(palettes.Greys256)
SEQUENTIAL = tuple(palettes.Viridis256)
DIVERGING = tuple(palettes.interp_palette(palettes.RdBu11, 255))
NOTHING = "#d81b60"  # of pixels that say nothing: no palette has it
MARK, SOFT = "#2b8cbe", "#87919c"  # of marks and of what they are compared with, on light and on dark paper
SERIES = tuple(palettes.Dark2_8)
CROSS = "#ff2d78"  # of the lines through the pointer's place
DARK = "#101820"  # of a sensor where no sub-image falls on it
BORDERS = {"min_border_left": 52, "min_border_right": 14, "min_border_top": 8}  # page.css knows them too
BELOW_MAP, BELOW = 108, 50
WHOLE = "return Math.floor(value).toString()"


@dataclass(frozen=True)
class Colours:
    """How numbers become colours: the palette's ends, and what they are numbers of."""

    palette: tuple[str, ...]
    low: float
    high: float
    unit: str

    def mapper(self, low: float | None = None, high: float | None = None, **more: Any) -> Any:
        """Bokeh's; `low` and `high` where the pixels are stored as other numbers."""
        ends = self.low if low is None else low, self.high if high is None else high
        return LinearColorMapper(palette=list(self.palette), low=ends[0], high=ends[1], nan_color=NOTHING, **more)


@dataclass(frozen=True)
class View:
    """Ranges that several maps share, and the lines that show the pointer's place in all of them."""

    x: Any
    y: Any
    spans: tuple[Any, Any]


def view(left: float, right: float, top: float, bottom: float) -> View:
    """Rows grow downwards; nobody gets farther away than twice the whole."""
    wide, high = right - left, bottom - top
    spans = tuple(Span(dimension=name, line_color=CROSS, line_width=1, line_dash="4 3") for name in ("width", "height"))
    return View(
        Range1d(start=left, end=right, bounds=(left - wide / 2, right + wide / 2)),
        Range1d(start=bottom, end=top, bounds=(top - high / 2, bottom + high / 2)),
        (spans[0], spans[1]),
    )


def source(columns: Mapping[str, Sequence[Any]], name: str) -> Any:
    """Columns that figures share; the page finds them by name."""
    return ColumnDataSource({key: list(values) for key, values in columns.items()}, name=name)


def map_figure(
    name: str,
    data: Any,
    field: str,
    colours: Colours,
    shown: View,
    tips: Tips,
    *,
    places: tuple[Any, Any, Any, Any],
    axes: tuple[str, str] = ("column", "row"),
    mapper: Any = None,
    formatters: dict[str, Any] | None = None,
    ground: str | None = None,
) -> Any:
    """A map, or several beside each other, with a colour bar below.

    places : x, y, width and height, numbers or columns of `data`;  mapper : where pixels are stored as other numbers
    ground : colour of what no map covers
    """
    drawn = _blank(name, BELOW_MAP, axes, x_range=shown.x, y_range=shown.y)
    x, y, width, height = places
    drawn.image(
        image=field, source=data, x=x, y=y, dw=width, dh=height, color_mapper=mapper or colours.mapper(), level="image"
    )
    drawn.grid.visible = False
    drawn.background_fill_color = ground
    bar = ColorBar(
        color_mapper=colours.mapper(),
        ticker=BasicTicker(desired_num_ticks=5),
        title=colours.unit,
        height=10,
        padding=6,
        margin=0,
        background_fill_color=None,
        title_text_font_style="normal",
        title_text_font_size="12px",
        major_label_text_font_size="12px",
        location="center",
    )
    drawn.add_layout(bar, "below")
    whole = CustomJSHover(code=WHOLE)
    known = {"$x": whole, "$y": whole, **(formatters or {})}
    drawn.add_tools(
        PanTool(),
        WheelZoomTool(modifiers="ctrl", zoom_on_axis=False),
        HoverTool(tooltips=tips, formatters=known, attachment="horizontal"),
        CrosshairTool(overlay=shown.spans),
    )
    drawn.toolbar.active_scroll = drawn.tools[1]
    return drawn


def chart(name: str, axes: tuple[str, str], **options: Any) -> Any:
    """An empty chart of numbers against numbers."""
    drawn = _blank(name, BELOW, axes, **options)
    drawn.grid.grid_line_alpha = 0.35
    return drawn


def hover(drawn: Any, renderers: Sequence[Any], tips: Tips, formatters: dict[str, Any] | None = None) -> None:
    """Values under the pointer for some of a chart's marks."""
    drawn.add_tools(HoverTool(renderers=list(renderers), tooltips=tips, formatters=formatters or {}))


def legend(drawn: Any, place: str) -> None:
    """A legend without a box of its own; what is clicked on goes away and comes back."""
    drawn.legend.location = place
    drawn.legend.click_policy = "hide"
    drawn.legend.label_text_font_size = "12px"
    drawn.legend.background_fill_alpha = 0.7
    drawn.legend.spacing = 1


def _blank(name: str, below: int, axes: tuple[str, str], **options: Any) -> Any:
    drawn = figure(
        name=name,
        tools="",
        toolbar_location=None,
        sizing_mode="stretch_both",
        min_border_bottom=below,
        background_fill_color=None,
        border_fill_color=None,
        x_axis_label=axes[0],
        y_axis_label=axes[1],
        **BORDERS,
        **options,
    )
    drawn.axis.axis_label_text_font_style = "normal"
    drawn.axis.axis_label_text_font_size = "12px"
    drawn.axis.major_label_text_font_size = "12px"
    drawn.axis.axis_label_standoff = 4
    drawn.axis.minor_tick_line_color = None
    return drawn


def script() -> str:
    """Bokeh's own program, to be put into the page: no part of it for widgets, tables or WebGL is needed."""
    [path] = Resources(mode="absolute", minified=True, components=["bokeh"]).js_files
    return Path(path).read_text(encoding="utf-8").replace("</script", "<\\/script")


def document(figures: Sequence[Any]) -> str:
    """The figures as JSON that can stand in a page: Bokeh's document, and which of its roots goes where.

    The same figures always give the same text: models that Bokeh counts through a process are counted anew.
    """
    made = Document()
    for drawn in figures:
        made.add_root(drawn)
    numbers: dict[str, str] = {}
    content = _renumbered(made.to_json(deferred=False), numbers)
    roots = {numbers[drawn.id]: f"plot-{drawn.name}" for drawn in figures}
    return json.dumps({"document": content, "roots": roots}, allow_nan=False).replace("<", "\\u003c")


def _renumbered(content: Any, numbers: dict[str, str]) -> Any:
    if isinstance(content, list | tuple):
        return [_renumbered(one, numbers) for one in content]
    if not isinstance(content, dict):
        return content
    found = {key: _renumbered(value, numbers) for key, value in content.items() if key != "id"}
    if "id" in content:
        found["id"] = numbers.setdefault(content["id"], f"m{len(numbers)}")
    return found


def decoded(low: float, step: float, missing: int) -> Any:
    """Says the value that a whole number stands for."""
    code = "return value == missing ? 'none: dead' : (low + step * value).toPrecision(5)"
    return CustomJSHover(args={"low": low, "step": step, "missing": missing}, code=code)


def within(corner: str, data: Any) -> Any:
    """Says how far the pointer is from the corner, a column of `data`, of the map that it is on."""
    code = "return Math.floor(value - data.data[corner][special_vars.index]).toString()"
    return CustomJSHover(args={"corner": corner, "data": data}, code=code)
