"""Timing of several methods in alternation, so that other load on the machine slows all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter

import numpy as np

from ommatid.runtime.arrays import FloatArray

Work = Callable[[int], object]  # takes a seed, a different one each time


def alternate(methods: Sequence[Work], repeats: int) -> FloatArray:
    """Return seconds, (methods, repeats), measured in the order A B C A B C ...; the caller warms the methods up."""
    seconds = np.empty((len(methods), repeats))
    for repeat in range(repeats):
        for index, method in enumerate(methods):
            start = perf_counter()
            method(repeat + 1)
            seconds[index, repeat] = perf_counter() - start
    return seconds
