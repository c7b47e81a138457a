"""Labels beside the points of a plot that do not overlap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

LINE_HEIGHT = 0.035  # distance between labels, as a fraction of the panel's height


class Label(NamedTuple):
    """The text of a point at (x, y), and its colour."""

    x: float
    y: float
    text: str
    colour: str


def label_points(panel: Any, labels: Sequence[Label], widening: float) -> None:
    """Write the labels in one column to the right of all points, each with a thin line to its point.

    widening : factor by which the span of the logarithmic x axis is extended to make room
    """
    left, right = panel.get_xlim()
    panel.set_xlim(left, left * (right / left) ** widening)
    low, high = np.log(panel.get_ylim())
    floor = float(panel.get_ylim()[0])  # where a logarithmic axis shows an error of 0
    rising = sorted((label._replace(y=max(label.y, floor)) for label in labels), key=lambda label: label.y)
    centers = [float((np.log(label.y) - low) / (high - low)) for label in rising]
    heights = [LINE_HEIGHT * (1 + label.text.count("\n")) for label in rising]
    for center, label in zip(_separated(centers, heights), rising, strict=True):
        line = {"arrowstyle": "-", "color": label.colour, "linewidth": 0.5, "alpha": 0.6, "relpos": (0, 0.5)}
        style = {"textcoords": "axes fraction", "va": "center", "fontsize": 8.5, "color": label.colour}
        panel.annotate(label.text, (label.x, label.y), xytext=(1.03 / widening, center), arrowprops=line, **style)


def _separated(centers: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Move rising positions between 0 and 1 apart until labels of these heights do not overlap."""
    moved: list[float] = []
    bottom = 0.0
    for center, height in zip(centers, heights, strict=True):
        moved.append(max(center, bottom + height / 2))
        bottom = moved[-1] + height / 2
    top = 1.0
    for index in reversed(range(len(moved))):
        moved[index] = min(moved[index], top - heights[index] / 2)
        top = moved[index] - heights[index] / 2
    return moved
