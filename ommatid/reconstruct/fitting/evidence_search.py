"""Search for the parameters of largest evidence, in boxes around the best point so far.

The evidence may change by thousands of units in one step, and a Cholesky factor exists in a part of the range only. A
search over the whole range would step to its bounds first, find no evidence there, and stop where it began. Inside a
box of some factors it cannot leave that part by far; the box follows the best point and shrinks where a search fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize

from ommatid.runtime.arrays import FloatArray

Score = Callable[[FloatArray], tuple[float, FloatArray]]
Bounds = list[tuple[float, float]]

REACH = 2.0  # half the width of a box, in logarithms
LEAST_REACH = 0.01  # half the width of the smallest box
MOST_BOXES = 25
STOP = {"ftol": 1e-7}  # a thousandth of one unit of log evidence, far below what it can distinguish
LEAST_GAIN = 1e-3  # of the log evidence, below which a box has gained nothing
LEVEL = 1.0  # slope by a logarithm below which the evidence is level
STEP = 1e-3  # of the logarithms, for the curvature
LARGEST_MISS = 0.05  # units of log evidence that another Newton step may gain at a maximum


@dataclass(frozen=True)
class SearchResult:
    """The best point, minus the log evidence there, and whether it is a maximum.

    spread : standard deviations of the parameters from the curvature; NaN where it is not positive
    on_bound : True if a parameter lies on the bound of its range
    """

    point: FloatArray
    value: float
    spread: tuple[float, ...]
    is_maximum: bool
    on_bound: bool


def search(score: Score, starts: list[FloatArray], bounds: Bounds) -> SearchResult:
    """Minimise a score with slope, minus the log evidence, from every start; return the best.

    score : infinite where the evidence does not exist
    """
    points = [_descent(score, start, bounds) for start in starts]
    point, value = min(points, key=lambda result: result[1])
    low, high = np.array(bounds).T
    on_bound = bool((np.minimum(point - low, high - point) < LEAST_REACH / 1e4).any())
    spread, miss = _curvature(score, point)
    is_maximum = bool(np.isfinite(value)) and miss <= LARGEST_MISS
    return SearchResult(point, value, spread, is_maximum, on_bound)


def _descent(score: Score, start: FloatArray, bounds: Bounds) -> tuple[FloatArray, float]:
    """Return the best point from one start, and its score."""
    minimize: Any = optimize.minimize
    low, high = np.array(bounds).T
    point, reach = start, REACH
    value = score(start)[0]
    for _ in range(MOST_BOXES):
        least, most = np.maximum(low, point - reach), np.minimum(high, point + reach)
        limits = list(zip(least, most, strict=True))
        result = minimize(_finite(score), point, jac=True, method="L-BFGS-B", bounds=limits, options=STOP)
        reached = score(result.x)[0]
        gain = value - reached if np.isfinite(reached) else 0.0
        if gain > 0:
            point, value = np.asarray(result.x, dtype=np.float64), reached
        inside = ((point > least) | (least <= low)) & ((point < most) | (most >= high))
        if inside.all() and _level(score, point, low, high):
            break
        if gain < LEAST_GAIN or inside.all():
            reach /= 4
        if reach < LEAST_REACH:
            break
    return point, value


def _finite(score: Score) -> Score:
    """Return a score that L-BFGS-B can interpolate: where there is none, the worst so far and more."""
    worst = [0.0]

    def finite(point: FloatArray) -> tuple[float, FloatArray]:
        value, slope = score(point)
        if not np.isfinite(value):
            return 10 * (1 + abs(worst[0])), np.zeros(point.size)
        worst[0] = max(worst[0], abs(value))
        return value, slope

    return finite


def _level(score: Score, point: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Return True if no slope is left but one that leads out of the range."""
    slope = score(point)[1]
    outwards = ((point <= low) & (slope > 0)) | ((point >= high) & (slope < 0))
    return bool((np.abs(np.where(outwards, 0.0, slope)) < LEVEL).all())


def _curvature(score: Score, point: FloatArray) -> tuple[tuple[float, ...], float]:
    """Return standard deviations of the parameters, and what a Newton step may still gain (infinite: unknown)."""
    unknown = (float("nan"),) * point.size, float("inf")
    sides = [(score(point + step), score(point - step)) for step in STEP * np.eye(point.size)]
    value, slope = score(point)
    if not all(np.isfinite([value, *(side[0] for pair in sides for side in pair)])):
        return unknown
    curvature = np.array([above[1] - below[1] for above, below in sides]) / (2 * STEP)
    curvature = 0.5 * (curvature + curvature.T)
    if not np.isfinite(curvature).all() or np.linalg.eigvalsh(curvature).min(initial=1.0) <= 0:
        return _partly(curvature, point.size), float("inf")
    inverse = np.linalg.inv(curvature)
    return tuple(float(value) for value in np.sqrt(np.diagonal(inverse))), float(0.5 * slope @ inverse @ slope)


def _partly(curvature: FloatArray, size: int) -> tuple[float, ...]:
    """Return the standard deviations that a curvature without a minimum still yields, NaN for the others."""
    try:
        variances = np.diagonal(np.linalg.inv(curvature))
    except np.linalg.LinAlgError:
        variances = np.full(size, np.nan)
    return tuple(float(value) ** 0.5 if value > 0 else float("nan") for value in variances)
