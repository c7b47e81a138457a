"""Mitsuba's samplers: how many samples a pixel each can fill its grid with, and how fast its error should fall.

Mitsuba rounds other counts up by itself, with a warning; counts that fit are asked for instead, so that what is
recorded is what was used.
"""

from __future__ import annotations

from math import isqrt

from scenes.scene import Sampler


def fitting(sampler: Sampler, samples: int) -> int:
    """The least number of samples, no fewer than asked for, that fills a sampler's grid.

    Any for independent samples; a grid as square as may be for multijitter; squares for stratified; squares of primes
    for orthogonal arrays (strength 2, Bose); powers of four for ldsampler, whose two sequences are binary.
    """
    samples = max(samples, 1)
    if sampler == "independent":
        return samples
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


def filling(sampler: Sampler, most: int) -> int:
    """The largest number of samples, no more than `most`, that fills a sampler's grid; where there is none, the
    least."""
    return next((one for one in range(most, 0, -1) if fitting(sampler, one) == one), fitting(sampler, 1))
