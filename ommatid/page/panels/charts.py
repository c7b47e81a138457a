"""Charts: lines, dots and intervals on linear or logarithmic axes, which a template draws as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from typing import Any, Literal

from markupsafe import Markup

WIDTH, HEIGHT = 400, 250
LEFT, RIGHT, TOP, BOTTOM = 56, 10, 10, 42
SMALL_RANGE = 1.5  # decades, below which a logarithmic axis has ticks at 1, 2 and 5
TICKS = 5  # of a linear axis, about
MARGIN = 0.04  # of an axis without given ends, beyond the values
FLAT = 1e-12  # relative width of a range, below which all its values are equal


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
    from ..document import rendered

    x_ends = x.ends([value for part in series for value in part.x])
    y_ends = y.ends([value for part in series for value in (*part.y, *part.low, *part.high)])

    def across(value: float) -> float:
        return LEFT + x.place(value, x_ends) * (WIDTH - LEFT - RIGHT)

    def up(value: float) -> float:
        return HEIGHT - BOTTOM - y.place(value, y_ends) * (HEIGHT - TOP - BOTTOM)

    drawn = [
        {
            **vars(part),
            "points": [(across(at), up(value)) for at, value in zip(part.x, part.y, strict=True)],
            "intervals": [
                (across(at), up(low), up(high)) for at, low, high in zip(part.x, part.low, part.high, strict=False)
            ],
        }
        for part in series
    ]
    content: dict[str, Any] = {"name": name, "description": description, "x_label": x.label, "y_label": y.label}
    content |= {"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT}
    content |= {"top": TOP, "bottom": HEIGHT - BOTTOM, "series": drawn}
    content["across"] = [(across(value), _number(value)) for value in x.ticks(x_ends)]
    content["up"] = [(up(value), _number(value)) for value in y.ticks(y_ends)]
    return Markup(rendered("chart.svg", content))


def _number(value: float) -> str:
    text = f"{value:.3g}"
    mantissa, power, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if power else text
