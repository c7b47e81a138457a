"""A prior found from the recorded stack alone: its variance, its correlation length and, if asked, the noise.

They are where the marginal likelihood of the measurements is largest (Mardia and Marshall 1984),

    g - H f0 ~ N(0, C),   C = H P0 H^T + Rv,   P0 = variance P1,   P1 = exp(-distance / length),

minus twice its logarithm being log det C + r^T C^-1 r. With P0 = L L^T and B = Rv^-1/2 H L, everything comes from the
Cholesky factor of I + B^T B, (N, N), and from sums of squares: r^T C^-1 r = |Rv^-1/2 (r - H L u)|^2 + |u|^2.
A larger image is cut into tiles, whose likelihoods are multiplied as if they were independent: the cost grows with the
number of pixels, not with its cube (Stein, Chi and Welty 2004).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, log
from typing import Any

import numpy as np
from scipy import linalg, optimize, sparse

from scenes.errors import InputError

from .forms.form import Matrix, Vector
from .prior import between_pixels, lag_distances

SHORTEST, LONGEST = 0.05, 100.0  # correlation length: in pixels, and in sides of the image
RANGE = 1e10  # variances are looked for within this factor of where the search starts
STEP = 1e-3  # of the logarithms, for the curvature
ENOUGH = {"ftol": 1e-7}  # a thousandth of one unit of log likelihood, far below what it can tell
SIDE = 24  # pixels, of the tiles that a larger image is cut into
WHOLE = 1e-6  # of what a measurement sees: what may lie outside the tile that it counts for
FEWEST = 10  # measurements from which three numbers can be found


@dataclass(frozen=True)
class Fit:
    """What was found: variance, correlation length in pixels, and the noise variance, None where that was not asked.

    uncertainty : standard deviations of their logarithms, in this order, from the curvature of the likelihood; NaN
    where the likelihood does not bend
    """

    variance: float
    length: float
    noise_variance: float | None
    uncertainty: tuple[float, ...]
    evaluations: int


@dataclass(frozen=True)
class Evidence:
    """The measurements and what is known of them: r = g - H f0, and of Rv the part that is not to be found, (M,)."""

    matrix: sparse.csr_array
    residual: Vector
    known_noise: Vector
    shape: tuple[int, int]

    def score(self, logarithms: Vector) -> tuple[float, Vector]:
        """Minus the logarithm of the likelihood, and its gradient, by log variance, log length and log noise variance.

        logarithms : (3,), or (2,) where all of the noise is known
        """
        variance, length = exp(logarithms[0]), exp(logarithms[1])
        found = exp(logarithms[2]) if logarithms.size == 3 else 0.0
        noise = self.known_noise + found
        correlation, derivative = self._correlation(length)
        root = np.asarray(linalg.cholesky(correlation, lower=True, overwrite_a=True, check_finite=False))
        half = variance**0.5 * root
        inner: Matrix = half.T @ (self._weighted(1 / noise) @ half)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = np.asarray(linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)), True
        white: Vector = half.T @ (self.matrix.T @ (self.residual / noise))
        u: Vector = np.asarray(linalg.cho_solve(factor, white, check_finite=False))
        left: Vector = (self.residual - self.matrix @ (half @ u)) / noise
        determinant = float(np.log(noise).sum() + 2 * np.log(np.diagonal(factor[0])).sum())
        value = 0.5 * (determinant + float(noise @ left**2 + u @ u))
        # With G = (I + B^T B)^-1: H^T C^-1 H = L^-T (I - G) L^-1 and H^T C^-1 r = L^-T u, no large numbers cancel.
        shrunk = np.asarray(linalg.cho_solve(factor, np.eye(u.size), check_finite=False))
        half_way = np.asarray(linalg.solve_triangular(root, derivative, lower=True, check_finite=False))
        inside = np.asarray(linalg.solve_triangular(root, half_way.T, lower=True, check_finite=False))
        by_variance = u.size - float(np.trace(shrunk)) - float(u @ u)
        by_length = float(np.trace(inside)) - float(np.sum(shrunk * inside)) - float(u @ inside @ u)
        slope = [0.5 * by_variance, 0.5 * by_length]
        if logarithms.size == 3:
            inverse_trace = float(np.sum(1 / noise)) - float(
                np.sum(self._weighted(noise**-2) * (half @ shrunk @ half.T))
            )
            slope.append(0.5 * found * (inverse_trace - float(left @ left)))
        return value, np.array(slope)

    def _correlation(self, length: float) -> tuple[Matrix, Matrix]:
        """P1 and its derivative by the logarithm of the length: (N, N) each."""
        lags = lag_distances(self.shape) / length
        return between_pixels(np.exp(-lags), self.shape), between_pixels(lags * np.exp(-lags), self.shape)

    def _weighted(self, weights: Vector) -> Matrix:
        return np.asarray((self.matrix.T @ sparse.csr_array(self.matrix.multiply(weights[:, None]))).toarray())

    def blocks(self, side: int) -> list[Evidence]:
        """The same, cut into tiles of at most `side` x `side` pixels, each with the measurements that see it alone."""
        rows, columns = (np.array_split(np.arange(size), -(-size // side)) for size in self.shape)
        if len(rows) == len(columns) == 1:
            return [self]
        numbers = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        seen = abs(self.matrix)
        total = seen.sum(axis=1)
        found: list[Evidence] = []
        for some_rows in rows:
            for some_columns in columns:
                pixels = numbers[np.ix_(some_rows, some_columns)].ravel()
                inside = seen[:, pixels].sum(axis=1)
                whole = (total > 0) & (inside >= (1 - WHOLE) * total)
                matrix = sparse.csr_array(self.matrix[whole][:, pixels])
                shape = (some_rows.size, some_columns.size)
                found.append(Evidence(matrix, self.residual[whole], self.known_noise[whole], shape))
        return found


def fit(evidence: Evidence, variance: float, length: float, noise_variance: float | None) -> Fit:
    """Find the prior, and the noise where a `noise_variance` to start from is given, of largest marginal likelihood.

    variance, length (in pixels) : where the search starts
    Raises InputError where the measurements are too few.
    """
    if evidence.residual.size < FEWEST:
        raise InputError(f"a prior is found from {FEWEST} measurements or more, got {evidence.residual.size}")
    starts = [variance, length] if noise_variance is None else [variance, length, noise_variance]
    start = np.log(starts)
    reach = log(RANGE)
    bounds = [(value - reach, value + reach) for value in start]
    bounds[1] = (log(SHORTEST), log(LONGEST * max(evidence.shape)))
    start[1] = np.clip(start[1], *bounds[1])
    blocks = evidence.blocks(SIDE)

    def score(logarithms: Vector) -> tuple[float, Vector]:
        parts = [block.score(logarithms) for block in blocks]
        return sum(value for value, _ in parts), np.sum([slope for _, slope in parts], axis=0)

    minimize: Any = optimize.minimize
    found = minimize(score, start, jac=True, method="L-BFGS-B", bounds=bounds, options=ENOUGH)
    if not np.isfinite(found.fun):
        raise InputError("the likelihood of the stack has no maximum; set prior.kind to 'independent'")
    sizes = np.exp(found.x)
    return Fit(
        variance=float(sizes[0]),
        length=float(sizes[1]),
        noise_variance=None if noise_variance is None else float(sizes[2]),
        uncertainty=_uncertainty(score, found.x),
        evaluations=int(found.nfev),
    )


def _uncertainty(score: Callable[[Vector], tuple[float, Vector]], best: Vector) -> tuple[float, ...]:
    steps = STEP * np.eye(best.size)
    curvature = np.array([score(best + step)[1] - score(best - step)[1] for step in steps]) / (2 * STEP)
    try:
        spread = np.diagonal(np.linalg.inv(0.5 * (curvature + curvature.T)))
    except np.linalg.LinAlgError:
        spread = np.full(best.size, np.nan)
    with np.errstate(invalid="ignore"):
        return tuple(float(value) for value in np.sqrt(spread))
