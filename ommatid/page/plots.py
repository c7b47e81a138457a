"""Bokeh figures for the pages; the only module of the page that imports Bokeh.

A figure fills the element `plot-NAME`, whose height is set by the style sheet. Its borders are fixed, so that the style
sheet can reserve the space for square pixels. Colours of axes and text are set in the browser, light or dark.
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
MISSING_COLOUR = "#d81b60"  # of pixels without a value: in none of the palettes
MARK, SOFT = "#2b8cbe", "#87919c"  # of measured values and of references, on light and dark backgrounds
SERIES = tuple(palettes.Dark2_8)
CROSSHAIR = "#ff2d78"
DARK = "#101820"  # of the sensor between the sub-images
BORDERS = {"min_border_left": 52, "min_border_right": 14, "min_border_top": 8}  # page.css depends on these
BORDER_BELOW_MAP, BORDER_BELOW = 108, 50
TEXT_SIZE = "12px"


@dataclass(frozen=True)
class ColourScale:
    """A palette, the values at its ends, and the name of the quantity."""

    palette: tuple[str, ...]
    low: float
    high: float
    unit: str

    def mapper(self, low: float | None = None, high: float | None = None, **options: Any) -> Any:
        """Return Bokeh's colour mapper; `low` and `high` are given if the pixels are stored as codes."""
        return LinearColorMapper(
            palette=list(self.palette),
            low=self.low if low is None else low,
            high=self.high if high is None else high,
            nan_color=MISSING_COLOUR,
            **options,
        )


@dataclass(frozen=True)
class View:
    """Ranges that several maps share, and the lines that show the pointer's position in all of them."""

    x: Any
    y: Any
    spans: tuple[Any, Any]


def view(left: float, right: float, top: float, bottom: float) -> View:
    """Return a view with rows increasing downwards; one can zoom out to twice its size."""
    width, height = right - left, bottom - top
    spans = [Span(dimension=name, line_color=CROSSHAIR, line_width=1, line_dash="4 3") for name in ("width", "height")]
    return View(
        Range1d(start=left, end=right, bounds=(left - width / 2, right + width / 2)),
        Range1d(start=bottom, end=top, bounds=(top - height / 2, bottom + height / 2)),
        (spans[0], spans[1]),
    )


def source(columns: Mapping[str, Sequence[Any]], name: str = "") -> Any:
    """Return columns that figures share; the page's program finds them by name."""
    return ColumnDataSource({key: list(values) for key, values in columns.items()}, name=name)


def map_figure(
    name: str,
    data: Any,
    field: str,
    colours: ColourScale,
    shown: View,
    tips: Tips,
    *,
    area: tuple[Any, Any, Any, Any],
    axes: tuple[str, str] = ("column", "row"),
    mapper: Any = None,
    formatted: Sequence[str] = (),
    formatters: Mapping[str, Any] | None = None,
    background: str | None = None,
) -> Any:
    """Return a figure of a map, or of several maps side by side, with a colour bar below.

    area : x, y, width and height, as numbers or columns of `data`;  mapper : of pixels that are stored as codes
    formatted : columns with printf formats in `tips`;  formatters : other formatters of tooltips
    background : colour outside the maps
    """
    plot = _blank(name, BORDER_BELOW_MAP, axes, x_range=shown.x, y_range=shown.y)
    x, y, width, height = area
    plot.image(
        image=field, source=data, x=x, y=y, dw=width, dh=height, color_mapper=mapper or colours.mapper(), level="image"
    )
    plot.grid.visible = False
    plot.background_fill_color = background
    bar = ColorBar(
        color_mapper=colours.mapper(),
        ticker=BasicTicker(desired_num_ticks=5),
        title=colours.unit,
        height=10,
        padding=6,
        margin=0,
        background_fill_color=None,
        title_text_font_style="normal",
        title_text_font_size=TEXT_SIZE,
        major_label_text_font_size=TEXT_SIZE,
        location="center",
    )
    plot.add_layout(bar, "below")
    integer = CustomJSHover(code="return Math.floor(value).toString()")
    all_formatters = {"$x": integer, "$y": integer, **_printf(formatted), **(formatters or {})}
    wheel = WheelZoomTool(modifiers="ctrl", zoom_on_axis=False)
    hover = HoverTool(tooltips=tips, formatters=all_formatters, attachment="horizontal")
    plot.add_tools(PanTool(), wheel, hover, CrosshairTool(overlay=shown.spans))
    plot.toolbar.active_scroll = wheel
    return plot


def chart(name: str, axes: tuple[str, str], **options: Any) -> Any:
    """Return an empty chart."""
    plot = _blank(name, BORDER_BELOW, axes, **options)
    plot.grid.grid_line_alpha = 0.35
    return plot


def comparison(name: str, axes: tuple[str, str], data: Any, tips: Tips, scale: str = "log", size: int = 9) -> Any:
    """Return a chart of "measured" against "predicted" values with the line of equality and intervals.

    data : columns "predicted", "measured", and "low" and "high" for the ends of the intervals
    """
    plot = chart(name, axes, x_axis_type=scale, y_axis_type=scale)
    ends = [min(data.data["predicted"]), max(data.data["predicted"])]
    plot.line(ends, ends, line_dash="6 4", line_width=1.5, line_color=SOFT)
    interval = {"line_width": 9, "line_alpha": 0.35, "line_color": SOFT}
    intervals = plot.segment(x0="predicted", x1="predicted", y0="low", y1="high", source=data, **interval)
    marks = plot.scatter(x="predicted", y="measured", source=data, size=size, color=MARK)
    values = [("predicted", "@predicted{%.4g}"), ("measured", "@measured{%.4g}")]
    hover(plot, [marks, intervals], [*tips, *values], ("predicted", "measured"))
    return plot


def hover(plot: Any, renderers: Sequence[Any], tips: Tips, formatted: Sequence[str]) -> None:
    """Add tooltips to marks of a chart; `formatted` are the columns with printf formats in `tips`."""
    plot.add_tools(HoverTool(renderers=list(renderers), tooltips=tips, formatters=_printf(formatted)))


def _printf(columns: Sequence[str]) -> dict[str, Any]:
    return {f"@{name}": "printf" for name in columns}


def legend(plot: Any, location: str) -> None:
    """Add a legend; a click on an entry hides or shows its marks."""
    plot.legend.location = location
    plot.legend.click_policy = "hide"
    plot.legend.label_text_font_size = TEXT_SIZE
    plot.legend.background_fill_alpha = 0.7
    plot.legend.spacing = 1


def _blank(name: str, border_below: int, axes: tuple[str, str], **options: Any) -> Any:
    plot = figure(
        name=name,
        tools="",
        toolbar_location=None,
        sizing_mode="stretch_both",
        min_border_bottom=border_below,
        background_fill_color=None,
        border_fill_color=None,
        x_axis_label=axes[0],
        y_axis_label=axes[1],
        **BORDERS,
        **options,
    )
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_font_size = TEXT_SIZE
    plot.axis.major_label_text_font_size = TEXT_SIZE
    plot.axis.axis_label_standoff = 4
    plot.axis.minor_tick_line_color = None
    return plot


def script() -> str:
    """Return BokehJS for embedding, without its widgets, tables and WebGL."""
    [path] = Resources(mode="absolute", minified=True, components=["bokeh"]).js_files
    return Path(path).read_text(encoding="utf-8").replace("</script", "<\\/script")


def document(figures: Sequence[Any]) -> str:
    """Return the figures as JSON that can be embedded in HTML: Bokeh's document, and the element of each root.

    The same figures always give the same text: Bokeh numbers its models through a process, and they are renumbered.
    """
    bokeh_document = Document()
    with bokeh_document.models.freeze():  # else it looks for all models after each figure
        for plot in figures:
            bokeh_document.add_root(plot)
    numbers: dict[str, str] = {}
    content = _renumbered(bokeh_document.to_json(deferred=False), numbers)
    roots = {numbers[plot.id]: f"plot-{plot.name}" for plot in figures}
    return json.dumps({"document": content, "roots": roots}, allow_nan=False).replace("<", "\\u003c")


def _renumbered(content: Any, numbers: dict[str, str]) -> Any:
    if isinstance(content, list | tuple):
        return [_renumbered(item, numbers) for item in content]
    if not isinstance(content, dict):
        return content
    copy = {key: _renumbered(value, numbers) for key, value in content.items() if key != "id"}
    if "id" in content:
        copy["id"] = numbers.setdefault(content["id"], f"m{len(numbers)}")
    return copy


def decoded(low: float, step: float, missing: int) -> Any:
    """Return a formatter for the value that a code represents."""
    code = "return value == missing ? 'none (dead pixel)' : (low + step * value).toPrecision(5)"
    return CustomJSHover(args={"low": low, "step": step, "missing": missing}, code=code)


def distance_from(corner: str, data: Any) -> Any:
    """Return a formatter for the distance of the pointer from the corner, a column of `data`, of the map below it."""
    code = "return Math.floor(value - data.data[corner][special_vars.index]).toString()"
    return CustomJSHover(args={"corner": corner, "data": data}, code=code)
