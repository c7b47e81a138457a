"""Measured against predicted error in groups of pixels with similar posterior standard deviations.

The intervals allow for the correlation of the errors: they are those of as many independent errors as have the same
variance of their mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from scipy import special

from ommatid.analysis.averaging_kernel import ErrorWindow, why_none
from ommatid.runtime.arrays import FloatArray

from ..data import Run
from .charts import ChartAxis, ChartSeries, chart

GROUPS = 12
FEWEST_PIXELS = 20  # per group, on average
CONFIDENCE = 0.99
LOG_RATIO = 10  # ratio of the largest to the smallest error from which on the axes are logarithmic


@dataclass(frozen=True)
class ErrorGroup:
    """RMS errors of a group of pixels: predicted from the posterior variance, and measured.

    degrees_of_freedom : number of independent errors whose mean square varies as much, None if it is not known
    interval : contains the measured error with 99 % probability if the errors are Gaussian (chi-squared), None without
        the degrees of freedom
    """

    pixels: int
    degrees_of_freedom: float | None
    predicted: float
    measured: float
    interval: tuple[float, float] | None

    @property
    def is_inside(self) -> bool:
        """True if the measured error is inside a known interval."""
        return self.interval is not None and self.interval[0] <= self.measured <= self.interval[1]


def groups(run: Run, window: ErrorWindow | None = None) -> list[ErrorGroup]:
    """Return the groups in order of increasing posterior standard deviation; none if the truth is not known.

    window : correlation of the errors, None for independent ones, or where `why_none` says that it is not known
    """
    if run.truth is None:
        return []
    errors = np.square(run.estimate.astype(np.float64) - run.truth).ravel()
    variances = run.variance.astype(np.float64).ravel()
    count = int(np.clip(errors.size // FEWEST_PIXELS, 1, GROUPS))
    edges = np.unique(np.quantile(variances, np.linspace(0, 1, count + 1)[1:-1]))
    # Pixels of equal variance, of which frames have many, belong to one group.
    group = np.searchsorted(edges, variances, side="left")
    is_unknown = window is None and bool(why_none(run.stack.scene))
    found: list[ErrorGroup] = []
    for index in np.unique(group):
        pixels = np.flatnonzero(group == index)
        freedom = float(pixels.size) if window is None else window.degrees_of_freedom(pixels)
        freedom = None if is_unknown else freedom
        found.append(_group(errors[pixels], variances[pixels], freedom))
    return found


def _group(errors: FloatArray, variances: FloatArray, freedom: float | None) -> ErrorGroup:
    predicted = float(np.sqrt(variances.mean()))
    interval = None
    if freedom is not None:
        low, high = (
            predicted * float(np.sqrt(2 * special.gammaincinv(freedom / 2, quantile) / freedom))
            for quantile in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
        )
        interval = low, high
    return ErrorGroup(int(errors.size), freedom, predicted, float(np.sqrt(errors.mean())), interval)


def figure(groups: list[ErrorGroup]) -> Markup:
    """Draw measured against predicted RMS error, with the line of equality and the 99 % intervals that are known."""
    intervals = [group.interval for group in groups if group.interval is not None]
    numbers = [value for group in groups for value in (group.predicted, group.measured)]
    numbers += [end for interval in intervals for end in interval]
    logarithmic = min(numbers) > 0 and max(numbers) > LOG_RATIO * min(numbers)
    ends = [min(group.predicted for group in groups), max(group.predicted for group in groups)]
    dots = ChartSeries(
        "measured, with the 99 % interval" if intervals else "measured",
        [group.predicted for group in groups],
        [group.measured for group in groups],
        "dots",
        low=[low for low, _ in intervals],
        high=[high for _, high in intervals],
    )
    equal = ChartSeries("measured equals predicted", ends, ends, "dashed", 0)
    x, y = (ChartAxis(f"{name} RMS error of a pixel", logarithmic) for name in ("predicted", "measured"))
    return chart("errors", x, y, [equal, dots], words(groups))


def words(groups: list[ErrorGroup]) -> str:
    """Return how many groups agree with the prediction, and how to interpret it."""
    inside = sum(group.is_inside for group in groups)
    ratios = [group.measured / group.predicted for group in groups if group.predicted > 0]
    sentence = f"{inside} of {len(groups)} groups are inside their intervals"
    if any(group.interval is None for group in groups):
        sentence = f"{len(groups)} groups without intervals, since the correlation of their errors is not known"
    if ratios:
        sentence += f"; the ratio of measured to predicted error is {min(ratios):.2f} to {max(ratios):.2f}"
    return f"{sentence}."
