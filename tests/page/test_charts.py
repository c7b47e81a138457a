"""Charts as SVG: marks at their values, ticks at round numbers, and text that is escaped."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.page.panels.charts import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, ChartAxis, ChartSeries, chart


def dots(text: str) -> list[tuple[float, float]]:
    """Positions of the dots as shares of the frame, from its lower left corner."""
    found = re.findall(r'<circle [^>]*cx="([-.\d]+)" cy="([-.\d]+)"', text)
    width, height = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    return [((float(x) - LEFT) / width, (HEIGHT - BOTTOM - float(y)) / height) for x, y in found]


def test_marks_stand_at_their_values() -> None:
    x, y = ChartAxis("length (nm)", logarithmic=True, low=1.0, high=1000.0), ChartAxis("error", low=0.0, high=4.0)
    series = ChartSeries("measured", [1, 10, 1000], [0, 1, 4], "dots", low=[0, 0.5, 4], high=[0, 2, 4])
    text = chart("name", x, y, [series], "description")
    # Positions are rounded to a tenth of a unit.
    expected = [(0, 0), (1 / 3, 1 / 4), (1, 1)]
    for (across, up), (at, height) in zip(dots(text), expected, strict=True):
        assert (across, up) == pytest.approx((at, height), abs=0.1 / (HEIGHT - TOP - BOTTOM))
    bars = re.findall(r'class="interval c1" d="M[\d.]+ ([\d.]+)V([\d.]+)"', text)
    assert float(bars[1][0]) - float(bars[1][1]) == pytest.approx(1.5 / 4 * (HEIGHT - TOP - BOTTOM), abs=0.2)
    for label in ("length (nm)", "error", "measured", ">10<", ">1e3<"):
        assert label in text


def test_text_of_a_chart_is_escaped() -> None:
    series = ChartSeries("<b>", [1, 2], [1, 2], "dots", tips=["<i>", "&"])
    text = chart("name", ChartAxis("<x>"), ChartAxis("y"), [series], '"<script>')
    assert not re.search(r"<b>|<i>|<x>|<script>", text)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.booleans())
def test_ticks_lie_inside_and_their_steps_are_round(low: float, width: float, logarithmic: bool) -> None:
    ends = (low % 6 - 3, low % 6 - 3 + width % 9 + 0.01) if logarithmic else (low, low + width)
    ticks = ChartAxis("", logarithmic).ticks(ends)
    assert 2 <= len(ticks) <= 14
    places = [ChartAxis("", logarithmic).place(tick, ends) for tick in ticks]
    assert all(-1e-6 <= place <= 1 + 1e-6 for place in places)
    assert places == sorted(places)
    if not logarithmic:
        mantissa = f"{ticks[1] - ticks[0]:.5e}"
        assert mantissa[0] in "1259"  # 9.99999 is rounded from 10


def test_points_without_a_position_are_left_outside() -> None:
    axis = ChartAxis("", logarithmic=True)
    text = chart("name", axis, axis, [ChartSeries("", [1, 10, 0], [1, float("nan"), 5], "dots")], "")
    assert [position for position in dots(text) if min(position) >= 0] != []
    assert sum(min(position) < 0 for position in dots(text)) == 2
