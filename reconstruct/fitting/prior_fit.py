"""A prior, and the noise if asked, found from the stack: the search for the largest marginal likelihood.

A larger image is cut into tiles, whose likelihoods are multiplied as if they were independent: the cost grows with the
number of pixels, not with its cube (Stein, Chi and Welty 2004). The search starts from the best of a grid, since the
likelihood has a second maximum where all of an image is taken for noise, or all of the noise for an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import log
from typing import Any

import numpy as np
from scipy import linalg, optimize, sparse

from ommatid.runtime.errors import InputError

from ..forms.form import Vector
from ..methods.method import EstimationTask
from .evidence import Evidence

SIDE = 24  # pixels, of the tiles that a larger image is cut into
WHOLE = 10_000  # pixels, of an image all of whose tiles have a say
MOST_ALONG = 8  # tiles of a larger one, along each axis
ENOUGH_SEEN = 0.5  # of the measurements, that must lie whole in a tile; else tiles grow
SHORTEST, LONGEST = 0.05, 100.0  # correlation length: in pixels, and in sides of the image
LENGTHS = (1.0, 5.0, 25.0)  # pixels, of the grid
NOISES = (1e-8, 1e-5, 1e-3, 1e-1)  # of the measurements' mean square, of the grid
STARTS = 2  # points of the grid from which a search is made
RANGE = 1e12  # variances are looked for within this factor of the measurements' mean square
STOP = {"ftol": 1e-7}  # a thousandth of one unit of log likelihood, far below what it can tell
STEP = 1e-3  # of the logarithms, for the curvature
FEWEST = 10  # measurements from which three numbers can be found
HOPELESS = 1e300
EDGE = 1e-6  # of a logarithm, that counts as lying on its bound


@dataclass(frozen=True)
class PriorFit:
    """What was found; None what was not asked for. Lengths in pixels.

    spread : standard deviations of the logarithms of what was found, in this order, from the curvature of the
        likelihood; NaN where it does not bend
    measurements : how many had a say;  doubtful : whether a number lies on the bound of where it was looked for
    """

    variance: float | None
    length: float | None
    noise_variance: float | None
    spread: tuple[float, ...]
    measurements: int
    doubtful: bool


def evidence(task: EstimationTask, *, prior_known: bool, noise_known: bool) -> tuple[Evidence, list[Evidence]]:
    """What a task's measurements tell of what is to be found, its `believed` being the noise that is known: the whole
    of them, and in the tiles whose likelihoods are multiplied.

    Of a frame only some tiles have a say, side by side at equal distances: enough to find three numbers.
    """
    if task.model.unknowns <= WHOLE:
        prior = task.prior_on(task.shape) if prior_known else None
        matrix = task.model.matrix[task.used]
        residual = task.recorded[task.used] - matrix @ np.full(task.model.unknowns, task.prior.mean)
        whole = Evidence(matrix, residual, task.expected_noise, task.shape, prior, noise_known)
        return whole, _blocks(whole)
    starts = [np.unique(np.linspace(0, size - SIDE, MOST_ALONG).astype(int)) for size in task.shape]
    blocks: list[Evidence] = []
    shape = SIDE, SIDE
    prior = task.prior_on(shape) if prior_known else None
    places = np.cumsum(task.used) - 1
    for row, column in product(*starts):
        window = slice(row, row + SIDE), slice(column, column + SIDE)
        numbers = task.model.measurements_inside(*window)
        some = task.used[numbers]
        matrix = task.model.submatrix(*window)[some]
        residual = task.recorded[numbers[some]] - matrix @ np.full(SIDE * SIDE, task.prior.mean)
        blocks.append(Evidence(matrix, residual, task.expected_noise[places[numbers[some]]], shape, prior, noise_known))
    joined = sparse.csr_array(sparse.block_diag([block.matrix for block in blocks], format="csr"))
    residual = np.concatenate([block.residual for block in blocks])
    known = np.concatenate([block.known_noise for block in blocks])
    return Evidence(joined, residual, known, task.shape, prior, noise_known), blocks


def fit_prior(evidence: Evidence, blocks: list[Evidence] | None = None) -> PriorFit:
    """Find what the evidence leaves open. Raises InputError where it is too little, or without any noise."""
    blocks = _blocks(evidence) if blocks is None else blocks
    used = sum(block.residual.size for block in blocks)
    if used < FEWEST:
        raise InputError(f"a prior or the noise is found from {FEWEST} measurements or more, got {used}")
    if evidence.noise_known and not (evidence.known_noise > 0).all():
        raise InputError(
            "a prior cannot be found from measurements that are said to have no noise; set estimator.noise_variance"
            " to 'fit' or to a number above 0"
        )

    def score(logarithms: Vector) -> tuple[float, Vector]:
        try:
            parts = [block.score(logarithms) for block in blocks]
        except linalg.LinAlgError:  # so little noise beside the prior that float64 cannot tell: not the place to look
            return HOPELESS, np.zeros(logarithms.size)
        return sum(value for value, _ in parts), np.sum([slope for _, slope in parts], axis=0)

    bounds, starts = _bounds(evidence), _starts(evidence)
    starts = sorted(starts, key=lambda start: score(start)[0])[:STARTS]
    minimize: Any = optimize.minimize
    results = [minimize(score, start, jac=True, method="L-BFGS-B", bounds=bounds, options=STOP) for start in starts]
    best: Vector = min(results, key=lambda result: float(result.fun)).x
    doubtful = any(min(value - low, high - value) < EDGE for value, (low, high) in zip(best, bounds, strict=True))
    numbers = [float(number) for number in np.exp(best)]
    known = evidence.prior is not None
    return PriorFit(
        variance=None if known else numbers[0],
        length=None if known else numbers[1],
        noise_variance=None if evidence.noise_known else numbers[-1],
        spread=_spread([score(best + step)[1] - score(best - step)[1] for step in STEP * np.eye(best.size)]),
        measurements=used,
        doubtful=doubtful,
    )


def _blocks(evidence: Evidence) -> list[Evidence]:
    side = SIDE
    while side < max(evidence.shape):
        blocks = [block for block in evidence.blocks(side) if block.residual.size]
        if sum(block.residual.size for block in blocks) >= ENOUGH_SEEN * evidence.residual.size:
            return blocks
        side *= 2
    return [evidence]


def _mean_square(evidence: Evidence) -> float:
    square = float(np.mean(np.square(evidence.residual)))
    if square == 0:
        raise InputError("the measurements are what the prior's mean gives, to the last digit: nothing can be found")
    return square


def _starts(evidence: Evidence) -> list[Vector]:
    size = log(_mean_square(evidence))
    priors = [np.array([size, log(length)]) for length in LENGTHS] if evidence.prior is None else [np.zeros(0)]
    noises = [np.zeros(0)] if evidence.noise_known else [np.array([size + log(share)]) for share in NOISES]
    return [np.concatenate(pair) for pair in product(priors, noises)]


def _bounds(evidence: Evidence) -> list[tuple[float, float]]:
    size, reach = log(_mean_square(evidence)), log(RANGE)
    around = (size - reach, size + reach)
    lengths = (log(SHORTEST), log(LONGEST * max(evidence.shape)))
    return ([around, lengths] if evidence.prior is None else []) + ([] if evidence.noise_known else [around])


def _spread(differences: list[Vector]) -> tuple[float, ...]:
    curvature = np.array(differences) / (2 * STEP)
    try:
        inverse = np.diagonal(np.linalg.inv(0.5 * (curvature + curvature.T)))
    except np.linalg.LinAlgError:
        inverse = np.full(len(differences), np.nan)
    with np.errstate(invalid="ignore"):
        return tuple(float(value) for value in np.sqrt(inverse))
