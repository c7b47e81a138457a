"""Several ways to the same result, timed in turn, so that whatever else the machine does slows all of them alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

Work = Callable[[int], object]  # takes a seed, another one every time
VARIANTS = ("llvm_ad_mono", "scalar_rgb")


@dataclass(frozen=True)
class Row:
    """Ours against another way: their seconds repeat by repeat, the ratio hoped for, and how their results differ."""

    variant: str
    ours: str
    other: str
    seconds: NDArray[np.float64]
    other_seconds: NDArray[np.float64]
    aim: float | None
    check: str

    @property
    def ratios(self) -> NDArray[np.float64]:
        """How many times as long the other way took, in each repeat."""
        return self.other_seconds / self.seconds


def alternate(ways: list[Work], repeats: int) -> NDArray[np.float64]:
    """Seconds, (ways, repeats), measured as A B C A B C ...; whoever calls has warmed each of them up."""
    seconds = np.empty((len(ways), repeats))
    for number in range(repeats):
        for place, way in enumerate(ways):
            start = perf_counter()
            way(number + 1)
            seconds[place, number] = perf_counter() - start
    return seconds
