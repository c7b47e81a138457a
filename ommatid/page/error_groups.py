"""Measured against predicted error: pixels sorted by their posterior deviation, and what became of each group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from . import plots
from .data import Run

GROUPS = 12
FEWEST = 20  # pixels in a group, on average
SURE = 0.99
WIDE = 10  # ratio of the largest to the smallest error, from which on axes are logarithmic


@dataclass(frozen=True)
class ErrorGroup:
    """Pixels of like posterior deviation: how many, what was predicted and measured (rms), and the band.

    low, high : what holds the measured rms 99 times in 100 where errors are Gaussian and independent (chi-squared)
    """

    pixels: int
    predicted: float
    measured: float
    low: float
    high: float


def groups(run: Run) -> list[ErrorGroup]:
    """From the smallest posterior deviation to the largest; none without the truth."""
    if run.truth is None:
        return []
    errors = np.square(run.estimate.astype(np.float64) - run.truth).ravel()
    variances = run.variance.astype(np.float64).ravel()
    count = int(np.clip(errors.size // FEWEST, 1, GROUPS))
    edges = np.unique(np.quantile(variances, np.linspace(0, 1, count + 1)[1:-1]))
    # Equal deviations belong to one group: frames have many that are.
    place = np.searchsorted(edges, variances, side="left")
    return [_group(errors[place == number], variances[place == number]) for number in np.unique(place)]


def _group(errors: Any, variances: Any) -> ErrorGroup:
    predicted = float(np.sqrt(variances.mean()))
    low, high = (
        predicted * float(np.sqrt(stats.chi2.ppf(quantile, errors.size) / errors.size))
        for quantile in ((1 - SURE) / 2, (1 + SURE) / 2)
    )
    return ErrorGroup(int(errors.size), predicted, float(np.sqrt(errors.mean())), low, high)


def figure(found: list[ErrorGroup]) -> Any:
    """Measured against predicted rms, with the line where they agree and the band around it."""
    numbers = [value for group in found for value in (group.predicted, group.measured, group.low, group.high)]
    positive = [value for value in numbers if value > 0]
    scale = "log" if positive and max(positive) > WIDE * min(positive) and len(positive) == len(numbers) else "linear"
    drawn = plots.chart(
        "errors",
        ("predicted error of a pixel, rms", "measured error, rms"),
        x_axis_type=scale,
        y_axis_type=scale,
    )
    data = plots.source(
        {name: [getattr(group, name) for group in found] for name in ErrorGroup.__annotations__}, "groups"
    )
    ends = [min(group.predicted for group in found), max(group.predicted for group in found)]
    drawn.line(ends, ends, line_dash="6 4", line_width=1.5, line_color=plots.SOFT)
    band = drawn.segment(
        x0="predicted", x1="predicted", y0="low", y1="high", source=data, line_width=9,
        line_alpha=0.35, line_color=plots.SOFT,
    )  # fmt: skip
    marks = drawn.scatter(x="predicted", y="measured", source=data, size=9, color=plots.MARK)
    tips = [("pixels", "@pixels"), ("predicted", "@predicted{%.4g}"), ("measured", "@measured{%.4g}")]
    plots.hover(drawn, [marks, band], tips, {"@predicted": "printf", "@measured": "printf"})
    return drawn


def words(found: list[ErrorGroup]) -> str:
    """How many groups agree, and what to think of it."""
    inside = sum(group.low <= group.measured <= group.high for group in found)
    ratios = [group.measured / group.predicted for group in found if group.predicted > 0]
    told = f"{inside} of {len(found)} groups of pixels lie where 99 in 100 would if errors were independent"
    if ratios:
        told += f"; measured is {min(ratios):.2f} to {max(ratios):.2f} times predicted"
    return told + ". Errors of neighbours go together, so that groups may lie farther out than that."
