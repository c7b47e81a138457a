"""Mitsuba's samplers: the numbers of samples that fill their grids.

Mitsuba rounds other numbers up by itself, with a warning; numbers that fill the grid are requested instead, so that
the recorded number is the one that was used.
"""

from __future__ import annotations

from functools import cache
from math import isqrt
from typing import Literal

from ommatid.scenes.tables.estimation import Sampler

SOBOL: Literal["sobol"] = "sobol"  # points that are no sampler of Mitsuba's
RELATED_DRAWS: tuple[Sampler, ...] = ("stratified", "ldsampler")  # successive draws of a ray are far from independent


def fitting(sampler: Sampler | Literal["sobol"], samples: int) -> int:
    """Return the least number of samples, no fewer than `samples`, that fills a sampler's grid.

    Any number for independent samples; a grid as square as possible for multijitter; squares for stratified; squares
    of primes for orthogonal arrays (strength 2, Bose); powers of four for ldsampler, whose two sequences are binary;
    powers of two for Sobol's points.
    """
    samples = max(samples, 1)
    if sampler == "independent":
        return samples
    if sampler == SOBOL:
        return 1 << (samples - 1).bit_length()
    side = isqrt(samples)
    if sampler == "multijitter":
        return side * -(-samples // side)
    side += side * side < samples
    if sampler == "stratified":
        return side * side
    if sampler == "orthogonal":
        side = max(side, 2)
        while any(side % divisor == 0 for divisor in range(2, isqrt(side) + 1)):
            side += 1
        return side * side
    exponent = 1
    while 4**exponent < samples:
        exponent += 1
    return 4**exponent


@cache
def filling(sampler: Sampler | Literal["sobol"], most: int) -> int:
    """Return the largest number of samples up to `most` that fills a sampler's grid, or the least one if none does."""
    return next(
        (samples for samples in range(most, 0, -1) if fitting(sampler, samples) == samples), fitting(sampler, 1)
    )
