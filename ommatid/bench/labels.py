"""Words beside the points of a plot, none on top of another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

LINE = 0.035  # of a panel's height: how far apart labels stand
Label = tuple[float, float, str, str]  # of a point at x, y: words, colour


def spread(panel: Any, labels: Sequence[Label], wider: float) -> None:
    """Labels right of all points, not on top of one another, each with a thin line to its own.

    wider : how much the panel's axis is prolonged to make room, as a power of the span it has
    """
    left, right = panel.get_xlim()
    panel.set_xlim(left, left * (right / left) ** wider)
    low, high = np.log(panel.get_ylim())
    rising = sorted(labels, key=lambda one: one[1])
    places = [float((np.log(value) - low) / (high - low)) for _, value, _, _ in rising]
    apart = [LINE * (1 + words.count("\n")) for _, _, words, _ in rising]
    for place, (x, y, words, colour) in zip(_moved_apart(places, apart), rising, strict=True):
        leader = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.6, "relpos": (0, 0.5)}
        text = {"textcoords": "axes fraction", "va": "center", "fontsize": 8.5, "color": colour}
        panel.annotate(words, (x, y), xytext=(1.03 / wider, place), arrowprops=leader, **text)


def _moved_apart(places: Sequence[float], apart: Sequence[float]) -> list[float]:
    """Rising places between 0 and 1, moved until neighbours stand half their heights' sum from one another."""
    found: list[float] = []
    for number, place in enumerate(places):
        least = found[-1] + (apart[number] + apart[number - 1]) / 2 if found else apart[0] / 2
        found.append(max(place, least))
    most = 1.0
    for number in reversed(range(len(found))):
        found[number] = min(found[number], most - apart[number] / 2)
        most = found[number] - apart[number] / 2
    return found
