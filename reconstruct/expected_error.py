"""How large the error of an estimate is expected to be (Wood et al., Eq. 5), over all images and for a given one.

    error covariance = (I - A H) P0 (I - A H)^T + A Rvm A^T                       (Eq. 5)

Rvm is what the noise really is, whatever the estimator expects. Everything is summed from squares, pixel by pixel, so
that no variance can come out negative.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

from .forms.form import Form, Matrix, Vector
from .prior import Prior

Pixels = NDArray[np.intp]

CHUNK = 512


@dataclass(frozen=True)
class ExpectedError:
    """Eq. 5: (N,) `variance` of every pixel, and the parts of its mean that the prior and each noise bring.

    missing : the prior's part, "null space": what no measurement tells, or what the noise forbids to believe
    resolved : (N,), the diagonal of A H: how much of a pixel's value comes from the measurements, 0 to 1
    """

    variance: Vector
    missing: float
    parts: dict[str, float]
    resolved: Vector

    @property
    def mse(self) -> float:
        """Expected squared error, averaged over the pixels."""
        return float(self.variance.mean())

    @property
    def degrees_of_freedom(self) -> float:
        """Trace of A H: how many independent numbers the measurements tell of the image (Rodgers 2000, section 2.4)."""
        return float(self.resolved.sum())

    @property
    def resolution(self) -> Vector:
        """Width of the averaging kernel in pixels of f, (N,): 1 / sqrt((A H)_ii), infinite where nothing is seen.

        The side of the square of pixels that share one degree of freedom (after Purser and Huang 1993).
        """
        return widths(self.resolved)


@dataclass(frozen=True)
class Interval:
    """Expectation of the mean squared error given the image, and where it falls 99 times in 100."""

    mse: float
    low: float
    high: float


def expected_error(
    form: Form, noise: dict[str, Vector], truth: Prior | None = None, pixels: Pixels | None = None
) -> ExpectedError:
    """Eq. 5 with the noises, and the prior, as they really are.

    noise : named (M,) variances that together are Rvm;  truth : the real prior, where it is not the expected one
    pixels : of which alone the error is asked, absent: of all
    """
    problem = form.problem
    asked = np.arange(problem.unknowns) if pixels is None else pixels
    count, measurements = asked.size, problem.measurements
    by_column = sparse.csc_array(problem.matrix)
    total = np.sum(list(noise.values()), axis=0) if noise else np.zeros(measurements)
    missing, noisy, resolved, weights = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(measurements)
    for place, some, u, negative in columns(form, asked):
        if truth is None:
            missing[place] = np.square(u).sum(axis=0)
        else:
            units = _units(problem.unknowns, some)
            missing[place] = np.square(truth.apply_root_transposed(units + problem.matrix.T @ negative)).sum(axis=0)
        resolved[place] = -np.asarray(by_column[:, some].multiply(negative).sum(axis=0)).ravel()
        squared = np.square(negative)
        noisy[place] = total @ squared
        weights += squared.sum(axis=1) / count
    as_expected = truth is None and np.array_equal(total, problem.noise_variance)
    variance = form.variance()[asked] if as_expected else missing + noisy
    parts = {name: float(weights @ values) for name, values in noise.items()}
    return ExpectedError(variance, float(missing.mean()), parts, resolved)


def expected_given(form: Form, truth: Vector, noise_variance: Vector) -> Interval:
    """What the mean squared error of this very image should be: |(I - A H)(f - f0)|^2 + trace(A Rvm A^T), over N.

    A photograph is no draw from the prior, so Eq. 5 does not answer for it. The interval takes the error as a gamma
    variate of the same mean and variance, the quadratic form's own: with K = A Rvm A^T, 4 b^T K b + 2 trace(K^2).
    """
    problem = form.problem
    away = truth - problem.prior.mean
    bias = away - form.gain(problem.matrix @ away)
    trace = squares = 0.0
    for _, _, _, negative in columns(form, np.arange(problem.unknowns)):
        weighted = noise_variance[:, None] * negative
        trace += float(np.sum(weighted * negative))
        squares += float(np.square(form.gain(weighted)).sum())
    variance = 4 * _noise_of_sum(form, bias, noise_variance)[1] + 2 * squares
    return interval(float(bias @ bias) + trace, variance, truth.size)


def interval(mean: float, variance: float, count: int) -> Interval:
    """Of the mean of `count` squares whose sum has this mean and variance, taken as a gamma variate."""
    if variance <= 0:
        return Interval(mean / count, mean / count, mean / count)
    shape, scale = mean**2 / variance, variance / mean
    low, high = (float(stats.gamma.ppf(level, shape, scale=scale)) for level in (0.005, 0.995))
    return Interval(mean / count, low / count, high / count)


def widths(resolved: Vector) -> Vector:
    """1 / sqrt((A H)_ii), infinite where nothing is seen: (N,)."""
    root = np.sqrt(np.maximum(resolved, 0.0))
    return np.divide(1.0, root, out=np.full_like(root, np.inf), where=root > 0)


def variance_of_sum(form: Form, weights: Vector, noise_variance: Vector) -> float:
    """Expected squared error (Eq. 5) of the weighted sum w^T f^ of pixels: `weights`, (N,), such as 1/n in a region.

    Neighbours' errors go together or cancel, so this is not the sum of their variances.
    """
    missing, noisy = _noise_of_sum(form, weights, noise_variance)
    return missing + noisy


def _noise_of_sum(form: Form, weights: Vector, noise_variance: Vector) -> tuple[float, float]:
    """w^T (I - A H) P0 (I - A H)^T w and w^T A Rvm A^T w."""
    problem = form.problem
    u, negative = form.solve(problem.prior.apply_root_transposed(weights[:, None]), np.zeros((problem.measurements, 1)))
    return float(np.square(u).sum()), float(noise_variance @ np.square(negative[:, 0]))


def columns(form: Form, asked: Pixels) -> Iterator[tuple[slice, Pixels, Matrix, Matrix]]:
    """Some of the pixels asked for: u, (K, q), whose squares are the prior's part of Eq. 5, and -A^T e_i, (M, q)."""
    for start in range(0, asked.size, CHUNK):
        place = slice(start, min(start + CHUNK, asked.size))
        u, negative = form.pixel_solutions(asked[place])
        yield place, asked[place], u, negative


def _units(count: int, some: Pixels) -> Matrix:
    return np.eye(count)[:, some]
