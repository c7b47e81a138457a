"""How fast the error of a mean over rays falls with their number, by theory."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log

from ommatid.scenes.camera import Camera
from ommatid.scenes.tables.estimation import Sampler

IN_THE_LIMIT = 64  # samples in a pass: with fewer, strata that hold a corner are not few beside those along an edge


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
