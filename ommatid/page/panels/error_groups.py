"""Measured against predicted error in groups of pixels with similar posterior standard deviations.

The intervals allow for the correlation of the errors: they are those of as many independent errors as have the same
variance of their mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from scipy import special

from ommatid.analysis.quality.averaging_kernel import ErrorWindow
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

    degrees_of_freedom : number of independent errors whose mean square varies as much
    low, high : interval that contains the measured error with 99 % probability if the errors are Gaussian (chi-squared)
    """

    pixels: int
    degrees_of_freedom: float
    predicted: float
    measured: float
    low: float
    high: float

    @property
    def is_inside(self) -> bool:
        """True if the measured error is inside the interval."""
        return self.low <= self.measured <= self.high


def groups(run: Run, window: ErrorWindow | None = None) -> list[ErrorGroup]:
    """Return the groups in order of increasing posterior standard deviation; none if the truth is not known.

    window : correlation of the errors, None for independent ones
    """
    if run.truth is None:
        return []
    errors = np.square(run.estimate.astype(np.float64) - run.truth).ravel()
    variances = run.variance.astype(np.float64).ravel()
    count = int(np.clip(errors.size // FEWEST_PIXELS, 1, GROUPS))
    edges = np.unique(np.quantile(variances, np.linspace(0, 1, count + 1)[1:-1]))
    # Pixels of equal variance, of which frames have many, belong to one group.
    group = np.searchsorted(edges, variances, side="left")
    found: list[ErrorGroup] = []
    for index in np.unique(group):
        pixels = np.flatnonzero(group == index)
        freedom = float(pixels.size) if window is None else window.degrees_of_freedom(pixels)
        found.append(_group(errors[pixels], variances[pixels], freedom))
    return found


def _group(errors: FloatArray, variances: FloatArray, freedom: float) -> ErrorGroup:
    predicted = float(np.sqrt(variances.mean()))
    low, high = (
        predicted * float(np.sqrt(2 * special.gammaincinv(freedom / 2, quantile) / freedom))
        for quantile in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
    )
    return ErrorGroup(int(errors.size), freedom, predicted, float(np.sqrt(errors.mean())), low, high)


def figure(groups: list[ErrorGroup]) -> Markup:
    """Draw measured against predicted RMS error, with the line of equality and the 99 % intervals."""
    numbers = [value for group in groups for value in (group.predicted, group.measured, group.low, group.high)]
    logarithmic = min(numbers) > 0 and max(numbers) > LOG_RATIO * min(numbers)
    ends = [min(group.predicted for group in groups), max(group.predicted for group in groups)]
    dots = ChartSeries(
        "measured, with the 99 % interval",
        [group.predicted for group in groups],
        [group.measured for group in groups],
        "dots",
        low=[group.low for group in groups],
        high=[group.high for group in groups],
        tips=[f"{group.pixels} pixels: predicted {group.predicted:.4g}, {group.measured:.4g}" for group in groups],
    )
    equal = ChartSeries("measured equals predicted", ends, ends, "dashed", 0)
    x, y = (ChartAxis(f"{name} RMS error of a pixel", logarithmic) for name in ("predicted", "measured"))
    return chart("errors", x, y, [equal, dots], words(groups))


def words(groups: list[ErrorGroup]) -> str:
    """Return how many groups agree with the prediction, and how to interpret it."""
    inside = sum(group.is_inside for group in groups)
    ratios = [group.measured / group.predicted for group in groups if group.predicted > 0]
    sentence = f"{inside} of {len(groups)} groups are inside their intervals"
    if ratios:
        sentence += f"; the ratio of measured to predicted error is {min(ratios):.2f} to {max(ratios):.2f}"
    return f"{sentence}."
