"""A sampler whose every draw has a seed of its own, so that draws for one ray are independent of each other.

Mitsuba's stratified, multijitter and ldsampler number the permutations of successive draws: seed, seed + 1, ... Its
permutations of related numbers are related, so that some cells of the pupil hardly ever belong to some cells of the
pixel, in every pass. The mean over passes is then off by up to one standard deviation of a pass's mean, which the
scatter between passes cannot show. Unrelated seeds pair all cells equally often.
"""

# pyright: basic
from __future__ import annotations

from typing import Any

from ..sampling.seeds import seed_of_draw


class ReseededSampler:
    """Draws numbers for what follows the position in the pixel."""

    def __init__(self, sampler: Any, seed: int, lanes: int) -> None:
        """Wrap Mitsuba's sampler, which was seeded with `seed` for `lanes` rays."""
        self._sampler, self._seed, self._lanes, self._draws = sampler, seed, lanes, 0

    def next_1d(self) -> Any:
        """Draw a number for every ray."""
        return self.reseeded().next_1d()

    def next_2d(self) -> Any:
        """Draw two numbers for every ray."""
        return self.reseeded().next_2d()

    @property
    def has_drawn(self) -> bool:
        """True once numbers were drawn."""
        return self._draws > 0

    def reseeded(self) -> Any:
        """Return Mitsuba's sampler with the next seed."""
        self._draws += 1
        self._sampler.seed(seed_of_draw(self._seed, self._draws), self._lanes)
        return self._sampler
