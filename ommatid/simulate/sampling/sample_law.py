"""How the variance of a mean falls with the samples, as expected and as measured, and how many samples a goal takes."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log

from ommatid.scenes.tables.estimation import Sampler

from .passes import FEWEST_PASSES, Plan

STRATIFIED, INDEPENDENT = 1.5, 1.0  # exponents before they are measured: of strata only those along edges err
STEEPEST = 2.0  # largest exponent that a measurement is trusted with
LEAPS = (2.0, 64.0)  # least and largest growth of the samples from one round to the next


@dataclass(frozen=True)
class SampleLaw:
    """A variance that falls as 1 / passes and as samples^-exponent, with the samples of a pass."""

    exponent: float = INDEPENDENT

    @staticmethod
    def expected(sampler: Sampler) -> SampleLaw:
        """Return the law of a sampler through pinholes."""
        return SampleLaw(INDEPENDENT if sampler == "independent" else STRATIFIED)

    @staticmethod
    def measured(fall: float, growth: float) -> SampleLaw:
        """Return the law of a variance that fell by a factor while the samples grew by another, within limits."""
        return SampleLaw(min(max(log(fall) / log(growth), INDEPENDENT), STEEPEST))

    def ratio(self, few: Plan, many: Plan) -> float:
        """Return the variance by the second plan over that by the first."""
        return few.passes / many.passes * (few.samples / many.samples) ** self.exponent

    def samples(self, factor: float, last: Plan, most: int) -> int:
        """Predict the samples per pixel of a round that divides the variance of the last one by a factor.

        most : in a pass. A round takes at least twice as many samples as the last one, and not too many more.
        """
        each = last.samples * (factor * last.passes / FEWEST_PASSES) ** (1 / self.exponent)
        total = FEWEST_PASSES * each
        if each > most:
            total = most * last.passes * factor * (last.samples / most) ** self.exponent
        return ceil(min(max(total, LEAPS[0] * last.total), LEAPS[1] * last.total))
