"""What a whole frame costs as it grows, and whether its error is the one that was predicted."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from time import perf_counter

import numpy as np

from ommatid.reconstruct.frame.conjugate_gradients import Solution

from .fresh import call, memory_of
from .whole import MEAN, Whole, compile_all, predicted

SIZES = (256, 512, 1024, 2048, 4079, 4096)
REPEATS = {256: 7, 512: 5, 1024: 5, 2048: 3, 4079: 2, 4096: 2}
BORDER = 32  # pixels, from which on nothing of the border is left


@dataclass(frozen=True)
class GrowthRow:
    """A frame of size x size pixels in an interpreter of its own.

    seconds : the fewest of a few repeats, from nothing prepared; sizes cannot alternate, and other load only adds
    held, peak : gigabytes of the process with the data alone, and at its peak
    error : mean squared error of the interior
    """

    size: int
    seconds: float
    steps: int
    bound: float
    held: float
    peak: float
    error: float

    @property
    def cost(self) -> float:
        """Seconds / (N log N)."""
        return self.seconds / (self.size**2 * log(self.size**2))

    @property
    def surprise(self) -> float:
        """How far the error is from the predicted one, in standard errors."""
        variance, spread = predicted()
        return (self.error - variance) / spread * (self.size - 2 * BORDER)


def growth_rows() -> list[GrowthRow]:
    """One for each size."""
    return [GrowthRow(*call(grown, size)) for size in SIZES]


def grown(size: int) -> tuple[int, float, int, float, float, float, float]:
    """The fields of a `GrowthRow`, measured in this process."""
    compile_all()
    whole = Whole.drawn(size)
    seconds: list[float] = []
    found: list[Solution] = []

    def work() -> None:
        found.clear()
        start = perf_counter()
        found[:] = [whole.estimate()]
        seconds.append(perf_counter() - start)

    held, peak = memory_of(work)
    for _ in range(1, REPEATS.get(size, 1)):
        work()
    solution = found[-1]
    wrong = (solution.image + MEAN - whole.image).reshape(size, size)[BORDER:-BORDER, BORDER:-BORDER]
    error = float(np.square(wrong).mean())
    return size, min(seconds), solution.steps, solution.bound, held, peak, error
