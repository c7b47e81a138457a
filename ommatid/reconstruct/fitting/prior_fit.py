"""Fit a prior, and the noise if asked for, to a stack by maximising the evidence, the likelihood of the measurements.

With (Mardia and Marshall 1984)

    g - H f0 ~ N(0, C),   C = H P0 H^T + Rv,

minus twice its logarithm is log det C + r^T C^-1 r, without constants. With P0 = L L^T and B = Rv^-1/2 H L, everything
follows from the Cholesky factor of I + B^T B, (N, N), and from sums of squares:
r^T C^-1 r = |Rv^-1/2 (r - H L u)|^2 + |u|^2.

A larger image is cut into tiles, whose likelihoods are multiplied as if they were independent, so that the cost grows
with the number of pixels and not with its cube (Stein, Chi and Welty 2004). The search starts from the best points of a
grid, since the likelihood has a second maximum where the whole image is explained as noise, or all noise as image. A
fit is doubtful unless it is a maximum inside the range, and the stack shows an image at all.

The evidence may change by thousands of units in one step, and a Cholesky factor exists in a part of the range only. A
search over the whole range would step to its bounds first, find no evidence there, and stop where it began. Inside a
box of some factors it cannot leave that part by far; the box follows the best point and shrinks where a search fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import exp, log
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..methods.method import EstimationTask
from ..prior import Prior, exponential_spectrum, lag_distances, reflecting_root, wave_variances
from ..problem import gram

Score = Callable[[FloatArray], tuple[float, FloatArray]]
Bounds = list[tuple[float, float]]

OUTSIDE = 1e-6  # share of a measurement's footprint that may lie outside its tile
REACH = 2.0  # half the width of a box, in logarithms
LEAST_REACH = 0.01  # half the width of the smallest box
MOST_BOXES = 25
STOP = {"ftol": 1e-7}  # a thousandth of one unit of log evidence, far below what it can distinguish
LEAST_GAIN = 1e-3  # of the log evidence, below which a box has gained nothing
LEVEL = 1.0  # slope by a logarithm below which the evidence is level
STEP = 1e-3  # of the logarithms, for the curvature
LARGEST_MISS = 0.05  # units of log evidence that another Newton step may gain at a maximum
TILE = 24  # pixels, side of the tiles that a larger image is cut into
MAX_COMPLETE = 10_000  # pixels, of an image all of whose tiles are used
MAX_TILES = 8  # tiles of a larger image along each axis
MIN_USED = 0.5  # share of the measurements that must lie inside one tile; else tiles grow
MIN_LENGTH, MAX_LENGTH = 0.05, 100.0  # correlation length: in pixels, and in sides of the image
GRID_LENGTHS = (1.0, 5.0, 25.0)  # pixels
GRID_NOISES = (1e-8, 1e-5, 1e-3, 1e-1)  # of the measurements' mean square
STARTS = 2  # points of the grid from which a search starts
RANGE = 1e12  # variances lie within this factor of the measurements' mean square
SEEN = 7.0  # units of log likelihood by which an image must be more likely than none: p = 1e-3 for two parameters
MIN_MEASUREMENTS = 10  # for three parameters


@dataclass(frozen=True)
class Evidence:
    """Measurements, and the known parts of their covariance.

    residual : (M,) r = g - H f0;  known_noise : (M,), the part of Rv that is not to be fitted
    prior : P0 where it is known; None where variance and length of an exponential prior are to be fitted
    noise_known : True if `known_noise` is all of Rv
    """

    matrix: sparse.csr_array
    residual: FloatArray
    known_noise: FloatArray
    shape: tuple[int, int]
    prior: Prior | None
    noise_known: bool

    def score(self, logarithms: FloatArray) -> tuple[float, FloatArray]:
        """Return minus the log evidence and its gradient with respect to the logarithms of the parameters.

        logarithms : of variance and length (pixels) unless P0 is known, then of the noise variance unless that is known
        """
        if self.matrix.shape[0] < self.matrix.shape[1]:
            return self._score_by_measurements(logarithms)
        return self._score_by_pixels(logarithms)

    def _score_by_pixels(self, logarithms: FloatArray) -> tuple[float, FloatArray]:
        parameters, noise = self._parameters(logarithms)
        root = self._root(parameters)
        inner: FloatArray = root.T @ (self._normal_matrix(1 / noise) @ root)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = np.asarray(linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)), True
        right_side: FloatArray = root.T @ (self.matrix.T @ (self.residual / noise))
        u: FloatArray = np.asarray(linalg.cho_solve(factor, right_side, check_finite=False))
        multipliers: FloatArray = (self.residual - self.matrix @ (root @ u)) / noise
        determinant = float(np.log(noise).sum() + 2 * np.log(np.diagonal(factor[0])).sum())
        value = 0.5 * (determinant + float(noise @ multipliers**2 + u @ u))
        inverse = np.asarray(linalg.cho_solve(factor, np.eye(u.size), check_finite=False))
        # H^T C^-1 H = L^-T (I - G) L^-1 and H^T C^-1 r = L^-T u with G = `inverse`, so no large numbers cancel.
        left = 1 - np.diagonal(inverse) - np.square(u)
        slope = [0.5 * float(change @ left) for change in self._changes(parameters)]
        if not self.noise_known:
            trace = float(np.sum(self._normal_matrix(noise**-2) * (root @ inverse @ root.T)))
            squares = float(multipliers @ multipliers)
            slope.append(0.5 * parameters[-1] * (float(np.sum(1 / noise)) - trace - squares))
        return value, np.array(slope)

    def _score_by_measurements(self, logarithms: FloatArray) -> tuple[float, FloatArray]:
        """Return the same from C itself, the smaller matrix where measurements are fewer than pixels."""
        parameters, noise = self._parameters(logarithms)
        root = self.matrix @ self._root(parameters)
        covariance = root @ root.T + np.diag(noise)
        factor = np.asarray(linalg.cholesky(covariance, lower=True, check_finite=False)), True
        multipliers: FloatArray = np.asarray(linalg.cho_solve(factor, self.residual, check_finite=False))
        value = float(np.log(np.diagonal(factor[0])).sum()) + 0.5 * float(self.residual @ multipliers)
        inverse = np.asarray(linalg.cho_solve(factor, np.eye(noise.size), check_finite=False))
        traces = np.einsum("ij,ij->j", root, inverse @ root) - np.square(root.T @ multipliers)
        slope = [0.5 * float(change @ traces) for change in self._changes(parameters)]
        if not self.noise_known:
            slope.append(0.5 * parameters[-1] * (float(np.trace(inverse)) - float(multipliers @ multipliers)))
        return value, np.array(slope)

    def _parameters(self, logarithms: FloatArray) -> tuple[list[float], FloatArray]:
        """Return the parameters and the whole noise, (M,)."""
        parameters = [exp(value) for value in logarithms]
        return parameters, self.known_noise + (0.0 if self.noise_known else parameters[-1])

    def _root(self, parameters: list[float]) -> FloatArray:
        """Return L: (N, N)."""
        if self.prior is not None:
            return np.diag(self.prior.root) if self.prior.independent else self.prior.root
        return reflecting_root(parameters[0] * exponential_spectrum(self.shape, parameters[1]))

    def _changes(self, parameters: list[float]) -> list[FloatArray]:
        """Return derivatives of the logarithm of each wave's variance, (N,), by those of variance and length."""
        if self.prior is not None:
            return []
        lags = lag_distances(self.shape) / parameters[1]
        change = wave_variances(lags * np.exp(-lags)) / exponential_spectrum(self.shape, parameters[1])
        return [np.ones(change.size), change.ravel()]

    def blocks(self, side: int) -> list[Evidence]:
        """Cut into tiles of at most `side` x `side` pixels, each with the measurements that see it alone."""
        rows, columns = (np.array_split(np.arange(size), -(-size // side)) for size in self.shape)
        if len(rows) == len(columns) == 1:
            return [self]
        indices = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        return [
            self._tile(indices[np.ix_(tile_rows, tile_columns)].ravel(), (tile_rows.size, tile_columns.size))
            for tile_rows in rows
            for tile_columns in columns
        ]

    def _tile(self, pixels: NDArray[np.intp], shape: tuple[int, int]) -> Evidence:
        weights = abs(self.matrix)
        total, inside = weights.sum(axis=1), weights[:, pixels].sum(axis=1)
        whole = (total > 0) & (inside >= (1 - OUTSIDE) * total)
        prior = None if self.prior is None else self.prior.restrict(pixels)
        matrix = sparse.csr_array(self.matrix[whole][:, pixels])
        return Evidence(matrix, self.residual[whole], self.known_noise[whole], shape, prior, self.noise_known)

    def _normal_matrix(self, weights: FloatArray) -> FloatArray:
        """Return H^T diag(weights) H: (N, N)."""
        return gram(self.matrix, weights)


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


@dataclass(frozen=True)
class PriorFit:
    """Fitted parameters, None for those that were known. Lengths in pixels.

    spread : standard deviations of the logarithms of the fitted parameters, in this order, from the curvature of the
        likelihood; NaN where it is not positive
    measurements : number used
    doubtful : True if a parameter lies on the bound of its range, if the likelihood has no maximum there, or if none of
        its parameters is needed to explain the measurements
    """

    variance: float | None
    length: float | None
    noise_variance: float | None
    spread: tuple[float, ...]
    measurements: int
    doubtful: bool


def evidence_of(task: EstimationTask, *, prior_known: bool, noise_known: bool) -> tuple[Evidence, list[Evidence]]:
    """Return the evidence of a task's measurements, and the tiles whose likelihoods are multiplied.

    The task's expected noise is the part that is known. Of a large image only some tiles are used, at equal distances:
    enough for three parameters.
    """
    mean = task.prior.mean
    if task.model.unknowns <= MAX_COMPLETE and task.model.stored is not None:
        prior = task.prior_on(task.shape) if prior_known else None
        matrix = task.model.matrix[task.used]
        residual = task.recorded[task.used] - matrix @ np.full(task.model.unknowns, mean)
        whole = Evidence(matrix, residual, task.expected_noise, task.shape, prior, noise_known)
        return whole, _tiles(whole)
    starts = [np.unique(np.linspace(0, size - TILE, MAX_TILES).astype(int)) for size in task.shape]
    blocks: list[Evidence] = []
    shape = TILE, TILE
    prior = task.prior_on(shape) if prior_known else None
    for row, column in product(*starts):
        window = task.window(slice(row, row + TILE), slice(column, column + TILE))
        residual = window.recorded - window.matrix @ np.full(TILE * TILE, mean)
        blocks.append(Evidence(window.matrix, residual, window.expected_noise, shape, prior, noise_known))
    if not any(block.residual.size for block in blocks):
        raise InputError(
            f"a fit of the prior or the noise takes windows of {TILE} pixels, and no footprint lies inside one as a"
            " whole; give prior.kind = 'exponential' with its variance and correlation_length, and the noise"
        )
    joined = sparse.csr_array(sparse.block_diag([block.matrix for block in blocks], format="csr"))
    residual = np.concatenate([block.residual for block in blocks])
    known = np.concatenate([block.known_noise for block in blocks])
    return Evidence(joined, residual, known, task.shape, prior, noise_known), blocks


def fit_prior(evidence: Evidence, blocks: list[Evidence] | None = None) -> PriorFit:
    """Fit the parameters that the evidence leaves open.

    blocks : tiles whose likelihoods are multiplied, absent: cut from the evidence
    Raises InputError where measurements are too few, or have no noise.
    """
    blocks = _tiles(evidence) if blocks is None else blocks
    used = sum(block.residual.size for block in blocks)
    if used < MIN_MEASUREMENTS:
        raise InputError(f"a fit of the prior or the noise takes {MIN_MEASUREMENTS} measurements or more, got {used}")
    if evidence.noise_known and not (evidence.known_noise > 0).all():
        raise InputError(
            "a prior cannot be fitted to measurements without noise; set estimator.noise_variance to 'fit' or to a"
            " number above 0"
        )

    def score(logarithms: FloatArray) -> tuple[float, FloatArray]:
        try:
            parts = [block.score(logarithms) for block in blocks]
        except (linalg.LinAlgError, OverflowError):  # the noise is too small beside the prior for float64
            return float("inf"), np.zeros(logarithms.size)
        value, slope = sum(value for value, _ in parts), np.sum([slope for _, slope in parts], axis=0)
        return (value, slope) if np.isfinite([value, *slope]).all() else (float("inf"), np.zeros(logarithms.size))

    bounds, starts = _bounds(evidence), _starts(evidence)
    best = search(score, sorted(starts, key=lambda start: score(start)[0])[:STARTS], bounds)
    if not np.isfinite(best.value):
        raise InputError(
            "the prior cannot be fitted in double precision; raise estimator.noise_variance, or set it to 'fit'"
        )
    doubtful = best.on_bound or not best.is_maximum or not _shows_image(score, evidence, best)
    parameters = [float(number) for number in np.exp(best.point)]
    prior_known = evidence.prior is not None
    return PriorFit(
        variance=None if prior_known else parameters[0],
        length=None if prior_known else parameters[1],
        noise_variance=None if evidence.noise_known else parameters[-1],
        spread=best.spread,
        measurements=used,
        doubtful=doubtful,
    )


def _tiles(evidence: Evidence) -> list[Evidence]:
    side = TILE
    while side < max(evidence.shape):
        tiles = [tile for tile in evidence.blocks(side) if tile.residual.size]
        if sum(tile.residual.size for tile in tiles) >= MIN_USED * evidence.residual.size:
            return tiles
        side *= 2
    return [evidence]


def _log_mean_square(evidence: Evidence) -> float:
    square = float(np.mean(np.square(evidence.residual)))
    if square == 0:
        raise InputError("the measurements equal those of the prior's mean to the last digit: nothing can be fitted")
    return log(square)


def _starts(evidence: Evidence) -> list[FloatArray]:
    scale = _log_mean_square(evidence)
    priors = [np.array([scale, log(length)]) for length in GRID_LENGTHS] if evidence.prior is None else [np.zeros(0)]
    noises = [np.zeros(0)] if evidence.noise_known else [np.array([scale + log(share)]) for share in GRID_NOISES]
    return [np.concatenate(pair) for pair in product(priors, noises)]


def _bounds(evidence: Evidence) -> list[tuple[float, float]]:
    scale, reach = _log_mean_square(evidence), log(RANGE)
    variances = (scale - reach, scale + reach)
    lengths = (log(MIN_LENGTH), log(MAX_LENGTH * max(evidence.shape)))
    return ([variances, lengths] if evidence.prior is None else []) + ([] if evidence.noise_known else [variances])


def _shows_image(score: Score, evidence: Evidence, best: SearchResult) -> bool:
    """Return True if the measurements are much less likely with noise alone: a variance of the prior of almost 0.

    A known prior is not asked for; where the noise is fitted, it explains the whole mean square instead.
    """
    if evidence.prior is not None:
        return True
    bounds = _bounds(evidence)
    without = best.point.copy()
    without[0] = bounds[0][0]
    if not evidence.noise_known:
        without[2] = _log_mean_square(evidence)
    return score(without)[0] > best.value + SEEN
