"""Timing of several methods in alternation, so that other load on the machine slows all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ommatid.runtime.arrays import FloatArray

Work = Callable[[int], object]  # takes a seed, a different one each time
VARIANTS = ("llvm_ad_mono", "scalar_rgb")


@dataclass(frozen=True)
class Row:
    """ommatid's method against another one: seconds of each repeat, target ratio, and difference of the results."""

    variant: str
    ours: str
    other: str
    seconds: FloatArray
    other_seconds: FloatArray
    target: float | None
    check: str

    @property
    def ratios(self) -> FloatArray:
        """Time of the other method over that of ommatid's in each repeat."""
        return self.other_seconds / self.seconds


def alternate(methods: Sequence[Work], repeats: int) -> FloatArray:
    """Return seconds, (methods, repeats), measured in the order A B C A B C ...; the caller warms the methods up."""
    seconds = np.empty((len(methods), repeats))
    for repeat in range(repeats):
        for index, method in enumerate(methods):
            start = perf_counter()
            method(repeat + 1)
            seconds[index, repeat] = perf_counter() - start
    return seconds


def difference_words(image: FloatArray, other: FloatArray) -> str:
    """Return the RMS and the largest difference of two images in words."""
    difference = image - other
    return f"pixels differ by {np.sqrt((difference**2).mean()):.2g} RMS, {np.abs(difference).max():.2g} at most, of 255"
