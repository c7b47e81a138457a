"""Charts as SVG text: lines, dots and intervals on linear or logarithmic axes.

Colours are classes of the style sheet, so that a chart follows the light, dark and print styles without a program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from typing import Literal

from markupsafe import Markup, escape

WIDTH, HEIGHT = 400, 250
LEFT, RIGHT, TOP, BOTTOM = 56, 10, 10, 42
SMALL_RANGE = 1.5  # decades, below which a logarithmic axis has ticks at 1, 2 and 5
COLOURS = 4  # of the style sheet, numbered from 1; 0 is that of references
TICKS = 5  # of a linear axis, about
MARGIN = 0.04  # of an axis without given ends, beyond the values
FLAT = 1e-12  # relative width of a range, below which all its values are equal

Position = Callable[[float, float], tuple[float, float]]


@dataclass(frozen=True)
class ChartSeries:
    """Points of a chart: connected by a line, dashed or solid, or drawn as dots with intervals.

    colour : number of a colour of the style sheet;  low, high : ends of the intervals, empty without
    tips : texts shown at the dots, empty without
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    look: Literal["line", "dashed", "dots", "stars"] = "line"
    colour: int = 1
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    tips: Sequence[str] = ()


@dataclass(frozen=True)
class ChartAxis:
    """Label with its unit, scale, and ends; ends that are None follow from the values."""

    label: str
    logarithmic: bool = False
    low: float | None = None
    high: float | None = None

    def ends(self, values: Sequence[float]) -> tuple[float, float]:
        """Return the ends of the axis for these values."""
        usable = [value for value in values if isfinite(value) and (value > 0 or not self.logarithmic)]
        known = [self._scaled(value) for value in usable] or [0.0, 1.0]
        low, high = min(known), max(known)
        if high - low <= FLAT * max(abs(low), abs(high), 1.0):
            low, high = low - 0.5, high + 0.5
        space = MARGIN * (high - low)
        ends = self.low, self.high
        low = low - space if ends[0] is None else self._scaled(ends[0])
        return low, high + space if ends[1] is None else self._scaled(ends[1])

    def place(self, value: float, ends: tuple[float, float]) -> float:
        """Return the position of a value between the ends, 0 to 1; outside values lie outside."""
        if not isfinite(value) or (self.logarithmic and value <= 0):
            return -1.0
        return (self._scaled(value) - ends[0]) / (ends[1] - ends[0])

    def ticks(self, ends: tuple[float, float]) -> list[float]:
        """Return the values of the ticks."""
        return _logarithmic_ticks(*ends) if self.logarithmic else _linear_ticks(*ends)

    def _scaled(self, value: float) -> float:
        return log10(value) if self.logarithmic else value


def _linear_ticks(low: float, high: float) -> list[float]:
    raw = (high - low) / TICKS
    power = 10.0 ** floor(log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - FLAT))
    return [step * number for number in range(ceil(low / step - FLAT), floor(high / step + FLAT) + 1)]


def _logarithmic_ticks(low: float, high: float) -> list[float]:
    factors = (1, 2, 5) if high - low < SMALL_RANGE else (1,)
    decades = range(floor(low), ceil(high) + 1)
    step = max(1, ceil(len(decades) / 7))
    values = [factor * 10.0**decade for decade in decades[::step] for factor in factors]
    inside = [value for value in values if low - FLAT <= log10(value) <= high + FLAT]
    if len(inside) > 1:
        return inside
    return [10**low, 10 ** ((low + high) / 2), 10**high]


def chart(name: str, x: ChartAxis, y: ChartAxis, series: Sequence[ChartSeries], description: str) -> Markup:
    """Return a chart as an SVG element; lines are cut at the frame, and points without a position left out."""
    x_ends = x.ends([value for part in series for value in part.x])
    y_ends = y.ends([value for part in series for value in (*part.y, *part.low, *part.high)])

    def position(x_value: float, y_value: float) -> tuple[float, float]:
        across, up = x.place(x_value, x_ends), y.place(y_value, y_ends)
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)

    clip = f"clip-{name}"
    parts = [
        Markup('<svg class="drawing" id="chart-{}" viewBox="0 0 {} {}" role="img" aria-label="{}">').format(
            name, WIDTH, HEIGHT, description
        ),
        Markup('<clipPath id="{}"><rect x="{}" y="{}" width="{}" height="{}"/></clipPath>').format(
            clip, LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
        ),
        *(_tick(WIDTH, position(value, 0)[0], value, "x") for value in x.ticks(x_ends)),
        *(_tick(WIDTH, _height(y, y_ends, value), value, "y") for value in y.ticks(y_ends)),
        Markup('<rect class="frame" x="{}" y="{}" width="{}" height="{}"/>').format(
            LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
        ),
        Markup('<text class="axis" x="{}" y="{}">{}</text>').format((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 6, x.label),
        Markup('<text class="axis" transform="translate(13 {}) rotate(-90)">{}</text>').format(
            (TOP + HEIGHT - BOTTOM) / 2, y.label
        ),
        Markup('<g clip-path="url(#{})">').format(clip),
        *(_drawn(part, position) for part in series),
        Markup("</g></svg>"),
    ]
    return Markup("\n").join(parts) + legend(series)


def _height(y: ChartAxis, ends: tuple[float, float], value: float) -> float:
    return HEIGHT - BOTTOM - y.place(value, ends) * (HEIGHT - TOP - BOTTOM)


def _tick(width: int, place: float, value: float, axis: str) -> Markup:
    if axis == "x":
        line = Markup('<path class="grid" d="M{0:.1f} {1}V{2}"/>').format(place, TOP, HEIGHT - BOTTOM)
        return line + Markup('<text class="tick" x="{:.1f}" y="{}">{}</text>').format(
            place, HEIGHT - BOTTOM + 14, _number(value)
        )
    line = Markup('<path class="grid" d="M{1} {0:.1f}H{2}"/>').format(place, LEFT, width - RIGHT)
    return line + Markup('<text class="tick up" x="{}" y="{:.1f}">{}</text>').format(
        LEFT - 5, place + 4, _number(value)
    )


def _number(value: float) -> str:
    text = f"{value:.3g}"
    mantissa, power, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if power else text


def _drawn(series: ChartSeries, at: Position) -> Markup:
    colour = f"c{series.colour}"
    points = [at(x, y) for x, y in zip(series.x, series.y, strict=True)]
    if series.look in ("line", "dashed"):
        path = " ".join(f"{'L' if index else 'M'}{x:.1f} {y:.1f}" for index, (x, y) in enumerate(points))
        return Markup('<path class="{} {}" d="{}"/>').format(series.look, colour, path)
    drawn: list[Markup] = []
    for x, low, high in zip(series.x, series.low, series.high, strict=False):
        (left, bottom), (_, top) = at(x, low), at(x, high)
        drawn.append(Markup('<path class="interval {}" d="M{:.1f} {:.1f}V{:.1f}"/>').format(colour, left, bottom, top))
    tips = series.tips or [""] * len(points)
    size = 6 if series.look == "stars" else 4
    for (x, y), tip in zip(points, tips, strict=True):
        title = Markup("<title>{}</title>").format(tip) if tip else Markup("")
        drawn.append(
            Markup('<circle class="{} {}" cx="{:.1f}" cy="{:.1f}" r="{}">{}</circle>').format(
                series.look, colour, x, y, size, title
            )
        )
    return Markup("").join(drawn)


def legend(series: Sequence[ChartSeries]) -> Markup:
    """Return the names of the series with their looks, nothing where none has a name."""
    named = [part for part in series if part.name]
    if not named:
        return Markup("")
    entries = [
        Markup('<li><i class="{} c{}"></i>{}</li>').format(part.look, part.colour, escape(part.name)) for part in named
    ]
    return Markup('<ul class="legend">{}</ul>').format(Markup("").join(entries))
