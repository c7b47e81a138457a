"""Mitsuba's samplers: how many samples a pixel each can fill its grid with, and how fast its error should fall.

Mitsuba rounds other counts up by itself, with a warning; counts that fit are asked for instead, so that what is
recorded is what was used.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isqrt, log

from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Sampler

IN_THE_LIMIT = 64  # samples in a pass: with fewer, strata that hold a corner are not few beside those along an edge


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


@dataclass(frozen=True)
class ConvergenceLaw:
    """How the error of a mean over rays falls with their number, d log error / d log samples, as far as theory says.

    least : samples in one pass from which on the law holds
    """

    slope: float | None
    why: str
    least: int = 1


def law(sampler: Sampler, camera: Camera) -> ConvergenceLaw:
    """Of a sampler in front of the lenses of a camera and a flat target, which is constant over each of its pixels."""
    if sampler == "independent":
        return ConvergenceLaw(-0.5, "independent samples: the variance of a mean of n is 1/n of one's")
    if not all(kind.optics.is_pinhole for kind in camera.types):
        why = "rays differ in four or six numbers, and the sampler stratifies them only two by two"
        return ConvergenceLaw(None, why, IN_THE_LIMIT)
    if sampler == "ldsampler":
        why = "theory bounds it alone: by order of log(n)/n (Koksma and Hlawka), which is no slope"
        return ConvergenceLaw(None, why, IN_THE_LIMIT)
    why = "of n strata only those along edges, some n^1/2, err: n^1/2 / n^2 of variance (Mitchell 1996), for large n"
    return ConvergenceLaw(-0.75, why, IN_THE_LIMIT)


def corners(camera: Camera, fewest: int, most: int) -> float:
    """By how much a slope between so many samples in a pass may differ from -3/4, which holds in the limit.

    Of s x s strata, 2 (m - 1) s lie along edges of pixels of f, of which (m - 1)^2 hold two at once, a corner. Their
    variance lies between none and twice that of two, so the error's square is C s^-3 (1 + c / s), |c| <= (m - 1) / 2.
    """
    c = float(max(kind.ratio for kind in camera.types) - 1) / 2
    sides = fewest**0.5, most**0.5
    if c >= sides[0] or fewest == most:
        return inf
    return 0.5 * log((1 - c / sides[1]) / (1 - c / sides[0])) / log(most / fewest)
