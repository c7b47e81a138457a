"""Cost of a whole frame as its size increases, and its error against the predicted one."""

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
BORDER = 32  # pixels, beyond which the border has no effect


@dataclass(frozen=True)
class GrowthRow:
    """A frame of size x size pixels in an interpreter of its own.

    seconds : minimum over a few repeats, without preparation; sizes cannot alternate, and other load only adds time
    held, peak : gigabytes of the process with the data, and at its peak
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
    def score(self) -> float:
        """Difference of the error from the predicted one in standard errors."""
        variance, deviation = predicted()
        return (self.error - variance) / deviation * (self.size - 2 * BORDER)


def growth_rows() -> list[GrowthRow]:
    """Return a row for each size."""
    return [GrowthRow(*call(measured, size)) for size in SIZES]


def measured(size: int) -> tuple[int, float, int, float, float, float, float]:
    """Return the fields of a `GrowthRow`, measured in this process."""
    compile_all()
    whole = Whole.drawn(size)
    seconds: list[float] = []
    solutions: list[Solution] = []

    def work() -> None:
        solutions.clear()
        start = perf_counter()
        solutions.append(whole.estimate())
        seconds.append(perf_counter() - start)

    held, peak = memory_of(work)
    for _ in range(1, REPEATS.get(size, 1)):
        work()
    solution = solutions[-1]
    errors = (solution.image + MEAN - whole.image).reshape(size, size)[BORDER:-BORDER, BORDER:-BORDER]
    error = float(np.square(errors).mean())
    return size, min(seconds), solution.steps, solution.bound, held, peak, error
