"""Progress of the adaptive rendering of one sub-imager, and the prediction of how many samples it still needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, log
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray

from .passes import FEWEST_PASSES, Plan

STEEPEST = 2.0  # largest exponent that a measurement is trusted with
LEAPS = (2.0, 64.0)  # least and largest growth of the samples from one round to the next


@dataclass
class SubImagerProgress:
    """Progress of one sub-imager.

    next, last : plans of the next round and of the last one
    spent : samples of all rounds per pixel that was in each of them;  fewest : the same for the first pixel to be done
    rays : of all rounds;  seeds : number of passes so far
    scatter : variance of one pass of the last round, mean over the unfinished pixels
    exponent : of its fall with the samples of a pass;  ended : why the sub-imager ended, "" before that
    """

    next: Plan
    exponent: float
    last: Plan = field(default_factory=lambda: Plan(0, 0))
    rounds: int = 0
    spent: int = 0
    fewest: int = 0
    rays: int = 0
    seeds: int = 0
    scatter: float = 0.0
    ended: str = ""

    @staticmethod
    def from_json(values: dict[str, Any]) -> SubImagerProgress:
        """Create the progress from its fields in JSON's types."""
        fields: dict[str, Any] = {**values, **{name: Plan(**values[name]) for name in ("next", "last")}}
        return SubImagerProgress(**fields)

    def add_round(self, work: Plan, variance: FloatArray) -> None:
        """Account for a round, from its plan and the variances of its pixels' means."""
        scatter = mean_of_known(variance) * work.passes
        if self.scatter > 0 and scatter > 0 and work.samples > self.last.samples:
            fall = log(self.scatter / scatter) / log(work.samples / self.last.samples)
            self.exponent = min(max(fall, 1.0), STEEPEST)
        self.last, self.rounds = work, self.rounds + 1
        self.spent, self.seeds, self.rays = (
            self.spent + work.total,
            self.seeds + work.passes,
            self.rays + work.total * variance.size,
        )

    def predicted_samples(self, factor: float, most: int) -> int:
        """Predict the samples per pixel that divide the variance by `factor`, in passes of at most `most`."""
        each = self.last.samples * (factor * self.last.passes / FEWEST_PASSES) ** (1 / self.exponent)
        total = FEWEST_PASSES * each
        if each > most:
            total = most * self.last.passes * factor * (self.last.samples / most) ** self.exponent
        fewest, largest = (leap * self.last.total for leap in LEAPS)
        return ceil(min(max(total, fewest), largest))


def mean_of_known(variance: FloatArray) -> float:
    """Return the mean of the variances of pixels that receive light."""
    known = variance[np.isfinite(variance)]
    return float(known.mean()) if known.size else 0.0
