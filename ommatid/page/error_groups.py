"""Measured against predicted error in groups of pixels with similar posterior standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from ommatid.runtime.arrays import FloatArray

from . import plots
from .data import Run

GROUPS = 12
FEWEST_PIXELS = 20  # per group, on average
CONFIDENCE = 0.99
LOG_RATIO = 10  # ratio of the largest to the smallest error from which on the axes are logarithmic


@dataclass(frozen=True)
class ErrorGroup:
    """RMS errors of a group of pixels: predicted from the posterior variance, and measured.

    low, high : interval that contains the measured error with 99 % probability if the errors are Gaussian and
        independent (chi-squared)
    """

    pixels: int
    predicted: float
    measured: float
    low: float
    high: float

    @property
    def is_inside(self) -> bool:
        """True if the measured error is inside the interval."""
        return self.low <= self.measured <= self.high


def groups(run: Run) -> list[ErrorGroup]:
    """Return the groups in order of increasing posterior standard deviation; none if the truth is not known."""
    if run.truth is None:
        return []
    errors = np.square(run.estimate.astype(np.float64) - run.truth).ravel()
    variances = run.variance.astype(np.float64).ravel()
    count = int(np.clip(errors.size // FEWEST_PIXELS, 1, GROUPS))
    edges = np.unique(np.quantile(variances, np.linspace(0, 1, count + 1)[1:-1]))
    # Pixels of equal variance, of which frames have many, belong to one group.
    group = np.searchsorted(edges, variances, side="left")
    return [_group(errors[group == index], variances[group == index]) for index in np.unique(group)]


def _group(errors: FloatArray, variances: FloatArray) -> ErrorGroup:
    predicted = float(np.sqrt(variances.mean()))
    low, high = (
        predicted * float(np.sqrt(2 * special.gammaincinv(errors.size / 2, quantile) / errors.size))
        for quantile in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
    )
    return ErrorGroup(int(errors.size), predicted, float(np.sqrt(errors.mean())), low, high)


def figure(groups: list[ErrorGroup]) -> Any:
    """Draw measured against predicted RMS error, with the line of equality and the 99 % intervals."""
    numbers = [value for group in groups for value in (group.predicted, group.measured, group.low, group.high)]
    scale = "log" if min(numbers) > 0 and max(numbers) > LOG_RATIO * min(numbers) else "linear"
    columns = {name: [getattr(group, name) for group in groups] for name in ErrorGroup.__annotations__}
    axes = "predicted RMS error of a pixel", "measured RMS error"
    return plots.comparison("errors", axes, plots.source(columns, "groups"), [("pixels", "@pixels")], scale)


def words(groups: list[ErrorGroup]) -> str:
    """Return how many groups agree with the prediction, and how to interpret it."""
    inside = sum(group.is_inside for group in groups)
    ratios = [group.measured / group.predicted for group in groups if group.predicted > 0]
    sentence = f"{inside} of {len(groups)} groups are inside their intervals"
    if ratios:
        sentence += f"; the ratio of measured to predicted error is {min(ratios):.2f} to {max(ratios):.2f}"
    return f"{sentence}. Errors of neighbouring pixels are correlated, so more groups may be outside than 1 in 100."
