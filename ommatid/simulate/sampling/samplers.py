"""Mitsuba's samplers: the numbers of samples that fill their grids, and how fast the error of a mean falls.

Mitsuba rounds other numbers up by itself, with a warning; numbers that fill the grid are requested instead, so that
the recorded number is the one that was used.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isqrt, log

from ommatid.scenes.camera import Camera
from ommatid.scenes.tables.estimation import Sampler

RELATED_DRAWS: tuple[Sampler, ...] = ("stratified", "ldsampler")  # successive draws of a ray are far from independent
IN_THE_LIMIT = 64  # samples in a pass: with fewer, strata that hold a corner are not few beside those along an edge


def fitting(sampler: Sampler, samples: int) -> int:
    """Return the least number of samples, no fewer than `samples`, that fills a sampler's grid.

    Any number for independent samples; a grid as square as possible for multijitter; squares for stratified; squares
    of primes for orthogonal arrays (strength 2, Bose); powers of four for ldsampler, whose two sequences are binary.
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
    """Return the largest number of samples up to `most` that fills a sampler's grid, or the least one if none does."""
    return next(
        (samples for samples in range(most, 0, -1) if fitting(sampler, samples) == samples), fitting(sampler, 1)
    )


@dataclass(frozen=True)
class ConvergenceLaw:
    """Theoretical slope of the error of a mean over rays, d log error / d log samples; None where theory has none.

    why : the theory in one sentence;  least : samples in one pass from which the law holds
    """

    slope: float | None
    why: str
    least: int = 1


def law(sampler: Sampler, camera: Camera) -> ConvergenceLaw:
    """Return the law of a sampler in front of a camera's lenses and a flat target, constant over each pixel of f."""
    if sampler == "independent":
        return ConvergenceLaw(-0.5, "independent samples: the variance of a mean of n is 1/n of one's")
    if not all(lens_type.optics.is_pinhole for lens_type in camera.types):
        why = "rays differ in four or six numbers, and the sampler stratifies them only two by two"
        return ConvergenceLaw(None, why, IN_THE_LIMIT)
    if sampler == "ldsampler":
        why = "theory gives only a bound: of order log(n)/n (Koksma and Hlawka), which is no slope"
        return ConvergenceLaw(None, why, IN_THE_LIMIT)
    why = "of n strata only those along edges, some n^1/2, err: n^1/2 / n^2 of variance (Mitchell 1996), for large n"
    return ConvergenceLaw(-0.75, why, IN_THE_LIMIT)


def corners(camera: Camera, fewest: int, most: int) -> float:
    """Return by how much a slope between two numbers of samples in a pass may differ from its limit of -3/4.

    Of s x s strata, 2 (m - 1) s lie along edges of pixels of f, of which (m - 1)^2 hold two at once, a corner. Their
    variance lies between none and twice that of two, so the error's square is C s^-3 (1 + c / s), |c| <= (m - 1) / 2.
    """
    c = float(max(lens_type.ratio for lens_type in camera.types) - 1) / 2
    sides = fewest**0.5, most**0.5
    if c >= sides[0] or fewest == most:
        return inf
    return 0.5 * log((1 - c / sides[1]) / (1 - c / sides[0])) / log(most / fewest)
