"""Convergence rates, Pareto fronts, and the cheapest settings that reach the noise floor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import product
from math import inf
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.shrinkage import shrink_variances
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.sampling.passes import FEWEST_PASSES

from .table import AUTO, STAGES, Cell, ConvergenceCurve, Recommendation, Stage

Item = TypeVar("Item")

ROUNDING: dict[Stage, float] = {"render": 1e-5 * WHITE, "calibrate": 1e-5}  # errors below these are float32 rounding
IN_THE_LIMIT = 64  # samples in a pass: with fewer, strata that hold a corner are not few beside those along an edge
FEWEST_POINTS = 3  # of a fitted slope
TOLERANCE = 0.1  # relative excess over the noise floor that recommended settings may add in total
SAMPLES_KEYS = {"render": "render.samples", "calibrate": "calibration.samples"}


class Law(NamedTuple):
    """Theoretical slope of the error of a mean over rays, d log error / d log samples; None where theory has none.

    why : the theory in one sentence;  least : samples in one pass from which the law holds
    """

    slope: float | None
    why: str
    least: int = 1


def law(sampler: Sampler, camera: Camera) -> Law:
    """Return the law of a sampler in front of a camera's lenses and a flat target, constant over each pixel of f."""
    if sampler == "independent":
        return Law(-0.5, "independent samples: the variance of a mean of n is 1/n of one's")
    if not all(lens_type.optics.is_pinhole for lens_type in camera.types):
        why = "rays differ in four or six numbers, and the sampler stratifies them only two by two"
        return Law(None, why, IN_THE_LIMIT)
    if sampler == "ldsampler":
        why = "theory gives only a bound: of order log(n)/n (Koksma and Hlawka), which is no slope"
        return Law(None, why, IN_THE_LIMIT)
    why = "of n strata only those along edges, some n^1/2, err: n^1/2 / n^2 of variance (Mitchell 1996), for large n"
    return Law(-0.75, why, IN_THE_LIMIT)


def slope(cells: Sequence[Cell]) -> tuple[float, float] | None:
    """Fit the slope of cells that differ only in samples, by weighted least squares on logarithms; and its error.

    Returns None for fewer than three different numbers of samples. Each point is weighted by the inverse variance of
    its median logarithm over seeds; these variances are shrunk towards one another, since few repeats determine each of
    them poorly. The standard error follows from those variances, whether or not the points lie on a line.
    """
    known = [cell for cell in cells if cell.scatter and cell.samples and cell.repeats > 1 and cell.error > 0]
    if len({cell.samples for cell in known}) < FEWEST_POINTS:
        return None
    x = np.log([float(cell.samples or 1) for cell in known])
    y = np.log([cell.error for cell in known])
    repeats = np.array([cell.repeats for cell in known])
    scatter = np.square([cell.scatter or 0.0 for cell in known])
    weight = 1 / (shrink_variances(scatter, int(repeats.min())) * variance_of_median(repeats))
    line, covariance = np.polyfit(x, y, 1, w=np.sqrt(weight), cov="unscaled")
    return float(line[0]), float(covariance[0, 0]) ** 0.5


def curves(cells: Sequence[Cell], camera: Camera) -> list[ConvergenceCurve]:
    """Return the slope of each method of rendering and calibration, and its theoretical slope."""
    ways: dict[tuple[Stage, str, str | None], list[Cell]] = {}
    for cell in cells:
        if cell.stage in ROUNDING and cell.counted:
            ways.setdefault((cell.stage, cell.way, cell.variant), []).append(cell)
    return [_curve(of_way, camera) for of_way in ways.values()]


def _curve(cells: Sequence[Cell], camera: Camera) -> ConvergenceCurve:
    first = cells[0]
    theory = law(cast(Sampler, first.sampler), camera)
    least = theory.least * FEWEST_PASSES if theory.least > 1 else 0
    fit = slope([cell for cell in cells if cell.error > ROUNDING[first.stage] and (cell.samples or 0) >= least])
    why = theory.why
    if fit is None:
        why += "; fewer than three cells to fit, or errors at the level of rounding"
    elif least:
        why += f"; fitted from {least} samples on"
    return ConvergenceCurve(
        stage=first.stage,
        way=first.way,
        variant=first.variant,
        slope=fit and fit[0],
        slope_deviation=fit and fit[1],
        theory=theory.slope,
        why=why,
    )


def variance_of_median(repeats: NDArray[Any]) -> FloatArray:
    """Return the variance of the median of n normal values, in units of the variance of one value.

    pi / (2 n + pi - 2) is exact for n = 1 and for large n, within 2 % for odd n between, and up to 22 % too large for
    even n.
    """
    return np.pi / (2 * repeats + np.pi - 2)


def excess(cell: Cell, floor: float) -> float:
    """Return the relative increase of the mean squared error over `floor` that is due to one setting.

    An estimate with an error of e posterior standard deviations adds e^2.
    """
    if cell.stage == "reconstruct":
        return cell.error**2
    if cell.mse is None or floor <= 0:
        return inf
    return max(cell.mse / floor - 1, 0.0)


def recommend(cells: Sequence[Cell], floor: float) -> Recommendation:
    """Return the cheapest setting of each stage whose excesses add up to at most 10 %, else those of least excess.

    floor : mean squared error with exact light and exact H, with the scene's noise
    Rendering and calibration share the scene's sampler and variant.
    """

    def total(choice: Sequence[Cell]) -> float:
        return sum(excess(cell, floor) for cell in choice)

    choices = list(_choices(cells, floor))
    if floor <= 0 or not choices:
        why = "no cell of some stage was measured within the time limit; raise --within"
        if floor <= 0:
            why = "the scene has no noise, so there is no noise floor: more samples always reduce the error"
        return Recommendation(noise_floor=floor, why=why)
    sufficient = [choice for choice in choices if total(choice) <= TOLERANCE]
    limit = f"within {100 * TOLERANCE:g} % of the error with exact light and exact H"
    if sufficient:
        best = min(sufficient, key=lambda choice: sum(cell.seconds for cell in choice))
        reasons = [f"the cheapest {limit}: {round(100 * total(best), 4):.2g} % above it"]
    else:
        best = min(choices, key=total)
        reasons = [f"no measured setting is {limit}; these are the nearest, {100 * total(best):.0f} % above it"]
    reasons += [
        f'{SAMPLES_KEYS[cell.stage]} = "{AUTO}" took up to {cell.samples} samples per pixel'
        for cell in best
        if not cell.counted
    ]
    mse, chosen = floor * (1 + total(best)), {cell.stage: cell for cell in best}
    return Recommendation(noise_floor=floor, mse=mse, reached=bool(sufficient), why="; ".join(reasons), **chosen)


def _choices(cells: Sequence[Cell], floor: float) -> Iterator[tuple[Cell, ...]]:
    """Yield a cell of each stage, in the order of STAGES; rendering and calibration share a sampler and variant."""
    for key in dict.fromkeys((cell.sampler, cell.variant) for cell in cells if cell.stage == "render"):
        fronts: list[list[Cell]] = []
        for stage in STAGES:
            of_stage = [cell for cell in cells if cell.stage == stage and excess(cell, floor) < inf]
            usable = [cell for cell in of_stage if stage == "reconstruct" or (cell.sampler, cell.variant) == key]
            fronts.append(pareto_front(usable, lambda cell: cell.seconds, lambda cell: excess(cell, floor)))
        yield from product(*fronts)


def pareto_front(items: Iterable[Item], cost: Callable[[Item], float], error: Callable[[Item], float]) -> list[Item]:
    """Return the items than which no other has both less cost and less error, the cheapest first.

    Of equal items the first one stays.
    """
    front: list[Item] = []
    for item in sorted(items, key=lambda item: (cost(item), error(item))):
        if not front or error(item) < error(front[-1]):
            front.append(item)
    return front
