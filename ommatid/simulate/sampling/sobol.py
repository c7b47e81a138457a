"""Sobol's points, which fill a unit cube of several dimensions evenly, and the numbers of them that do so best."""

from __future__ import annotations

from functools import cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from .passes import BATCHES, FEWEST_PASSES, Plan

DIMENSIONS = 8  # of the points; what a ray draws beyond them is independent
BITS = 32


@cache
def sobol_points(samples: int) -> NDArray[np.uint32]:
    """Return the first `samples` points, a power of two, as 32-bit fractions: (dimensions, samples)."""
    from scipy.stats import qmc

    points = qmc.Sobol(DIMENSIONS, scramble=False, bits=BITS).random_base2((samples - 1).bit_length())
    return np.ascontiguousarray((points * 2.0**BITS).astype(np.uint32).T)


def power_of_two_plan(samples: int, most: int) -> Plan:
    """Divide at least `samples` per pixel over passes of a power of two, and of at most `most`."""
    each = 1 << (ceil(samples / FEWEST_PASSES) - 1).bit_length()
    if each <= most:
        return Plan(FEWEST_PASSES, each)
    each = 1 << (most.bit_length() - 1)
    return Plan(max(FEWEST_PASSES, BATCHES * ceil(samples / each / BATCHES)), each)
