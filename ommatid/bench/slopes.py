"""Convergence rates, Pareto fronts, and the cheapest settings that reach the noise floor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.shrinkage import shrink_variances
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.sampling.passes import FEWEST_PASSES

from .convergence import corners, law
from .table import AUTO, DENSE, STAGES, Cell, ConvergenceCurve, Recommendation, RecommendedSetting, Stage

Item = TypeVar("Item")

ROUNDING: dict[Stage, float] = {"render": 1e-5 * WHITE, "calibrate": 1e-5}  # errors below these are float32 rounding
CRITICAL_SCORE = 3.0  # standard errors within which a slope agrees with theory
FEWEST_POINTS = 3  # of a fitted slope
TOLERANCE = 0.1  # relative excess over the noise floor that recommended settings may add in total
SAMPLES_KEYS = {"render": "render.samples", "calibrate": "calibration.samples"}


@dataclass(frozen=True)
class Slope:
    """d log error / d log samples, and its standard error."""

    value: float
    deviation: float

    def agrees(self, theory: float, margin: float = 0.0) -> bool:
        """Return True if the slope is within 3 standard errors, plus `margin`, of the theoretical slope."""
        return abs(self.value - theory) <= CRITICAL_SCORE * self.deviation + margin


def slope(cells: Sequence[Cell]) -> Slope | None:
    """Fit the slope of cells that differ only in samples, by weighted least squares on logarithms.

    Returns None for fewer than three different numbers of samples. Each point is weighted by the inverse variance of
    its median logarithm over seeds; these variances are shrunk towards one another, since few repeats determine each of
    them poorly. The standard error follows from those variances, whether or not the points lie on a line.
    """
    known = [cell for cell in cells if cell.scatter and cell.samples and cell.repeats > 1 and cell.error.median > 0]
    if len({cell.samples for cell in known}) < FEWEST_POINTS:
        return None
    x = np.log([float(cell.samples or 1) for cell in known])
    y = np.log([cell.error.median for cell in known])
    repeats = np.array([cell.repeats for cell in known])
    scatter = np.square([cell.scatter or 0.0 for cell in known])
    weight = 1 / (shrink_variances(scatter, int(repeats.min())) * variance_of_median(repeats))
    line, covariance = np.polyfit(x, y, 1, w=np.sqrt(weight), cov="unscaled")
    return Slope(float(line[0]), float(covariance[0, 0]) ** 0.5)


def curves(cells: Sequence[Cell], camera: Camera) -> list[ConvergenceCurve]:
    """Return the slope of each method of rendering and calibration, and its theoretical slope."""
    fitted: list[ConvergenceCurve] = []
    for stage, limit in ROUNDING.items():
        counted = [cell for cell in cells if cell.stage == stage and cell.counted]
        for way, variant in dict.fromkeys((cell.way, cell.variant) for cell in counted):
            used = [cell for cell in counted if (cell.way, cell.variant) == (way, variant)]
            fitted.append(_curve([cell for cell in used if cell.error.median > limit], camera, stage, way, variant))
    return fitted


def _curve(cells: Sequence[Cell], camera: Camera, stage: Stage, way: str, variant: str | None) -> ConvergenceCurve:
    theory = law(cast(Sampler, way.split(", ")[-1]), camera)
    asymptotic = theory.least > 1
    used = [cell for cell in cells if not asymptotic or (cell.samples or 0) >= theory.least * FEWEST_PASSES]
    fit, why, agrees = slope(used), theory.why, None
    if fit is None:
        why += "; fewer than three cells to fit, or errors at the level of rounding"
    elif asymptotic:
        why += f"; fitted from {theory.least * FEWEST_PASSES} samples on"
    if fit is not None and theory.slope is not None:
        counts = [(cell.samples or 1) // FEWEST_PASSES for cell in used]
        margin = corners(camera, min(counts), max(counts)) if asymptotic else 0.0
        if 0 < margin < inf:
            why += f", where strata that contain corners may change it by {margin:.2g}"
        agrees = None if margin == inf else fit.agrees(theory.slope, margin)
    return ConvergenceCurve(
        stage=stage,
        way=way,
        variant=variant,
        slope=None if fit is None else fit.value,
        slope_deviation=None if fit is None else fit.deviation,
        theory=theory.slope,
        why=why,
        agrees=agrees,
    )


def variance_of_median(repeats: NDArray[Any]) -> FloatArray:
    """Return the variance of the median of n normal values, in units of the variance of one value.

    pi / (2 n + pi - 2) is exact for n = 1 and for large n, within 2 % for odd n between, and up to 22 % too large for
    even n.
    """
    return np.pi / (2 * repeats + np.pi - 2)


def median_seconds(cell: Cell) -> float:
    """Return the median duration of a cell, the cost in its Pareto front."""
    return cell.seconds.median


def median_error(cell: Cell) -> float:
    """Return the median error of a cell."""
    return cell.error.median


def excess(cell: Cell, floor: float) -> float:
    """Return the relative increase of the mean squared error over `floor` that is due to one setting.

    An estimate with an error of e posterior standard deviations adds e^2.
    """
    if cell.stage == "reconstruct":
        return cell.error.median**2
    if cell.mse is None or floor <= 0:
        return inf
    return max(cell.mse.median / floor - 1, 0.0)


def recommend(cells: Sequence[Cell], floor: float) -> Recommendation:
    """Return the cheapest setting of each stage whose excesses add up to at most 10 %, else those of least excess.

    floor : mean squared error with exact light and exact H, with the scene's noise
    Rendering and calibration share the scene's sampler and variant.
    """
    choices = list(_choices(cells, floor))
    if floor <= 0 or not choices:
        why = "no cell of some stage was measured within the time limit; raise --within"
        if floor <= 0:
            why = "the scene has no noise, so there is no noise floor: more samples always reduce the error"
        return Recommendation(noise_floor=floor, mse=None, reached=False, why=why)
    sufficient = [choice for choice in choices if _total_excess(choice, floor) <= TOLERANCE]
    if sufficient:
        best = min(sufficient, key=_total_seconds)
    else:
        best = min(choices, key=lambda choice: _total_excess(choice, floor))
    total = _total_excess(best, floor)
    limit = f"within {100 * TOLERANCE:g} % of the error with exact light and exact H"
    if sufficient:
        reasons = [f"the cheapest {limit}: {round(100 * total, 4):.2g} % above it"]
    else:
        reasons = [f"no measured setting is {limit}; these are the nearest, {100 * total:.0f} % above it"]
    reasons += [
        f'{SAMPLES_KEYS[cell.stage]} = "{AUTO}" took up to {cell.samples} samples per pixel'
        for cell in best
        if not cell.counted
    ]
    render, calibrate, reconstruct = (_recommended(cell) for cell in best)
    return Recommendation(
        noise_floor=floor,
        mse=floor * (1 + total),
        reached=bool(sufficient),
        why="; ".join(reasons),
        render=render,
        calibrate=calibrate,
        reconstruct=reconstruct,
    )


def _choices(cells: Sequence[Cell], floor: float) -> Iterator[tuple[Cell, ...]]:
    """Yield a cell of each stage, in the order of STAGES; rendering and calibration share a sampler and variant."""
    for key in dict.fromkeys(_sampler_and_variant(cell) for cell in cells if cell.stage == "render"):
        usable = [cell for cell in cells if cell.stage == "reconstruct" or _sampler_and_variant(cell) == key]
        yield from product(
            *(
                pareto_front(
                    [cell for cell in usable if cell.stage == stage and excess(cell, floor) < inf],
                    median_seconds,
                    lambda cell: excess(cell, floor),
                )
                for stage in STAGES
            )
        )


def _sampler_and_variant(cell: Cell) -> tuple[str, str | None]:
    return cell.way.split(", ")[-1], cell.variant


def _total_excess(choice: Sequence[Cell], floor: float) -> float:
    return sum(excess(cell, floor) for cell in choice)


def _total_seconds(choice: Sequence[Cell]) -> float:
    return sum(median_seconds(cell) for cell in choice)


def _recommended(cell: Cell) -> RecommendedSetting:
    seconds = cell.seconds.median
    if cell.stage == "reconstruct":
        method = AUTO if cell.way == DENSE else cell.way
        return RecommendedSetting(method=method, setting=cell.setting, seconds=seconds)
    *method, sampler = cell.way.split(", ")
    return RecommendedSetting(
        method=method[0] if method else None,
        sampler=sampler,
        variant=cell.variant,
        samples=cell.samples if cell.counted else AUTO,
        seconds=seconds,
    )


def pareto_front(items: Iterable[Item], cost: Callable[[Item], float], error: Callable[[Item], float]) -> list[Item]:
    """Return the items than which no other has both less cost and less error, the cheapest first.

    Of equal items the first one stays.
    """
    front: list[Item] = []
    for item in sorted(items, key=lambda item: (cost(item), error(item))):
        if not front or error(item) < error(front[-1]):
            front.append(item)
    return front
