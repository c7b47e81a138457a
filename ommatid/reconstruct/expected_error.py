"""The expected error of an estimate (Wood et al., Eq. 5), on average over all images and for a given one.

    error covariance = (I - A H) P0 (I - A H)^T + A Rvm A^T                       (Eq. 5)

Rvm is the actual noise, whatever the estimator expects. Every pixel's variance is a sum |u|^2 + l^T Rvm l of squares of
solutions for r = 0, so that none can come out negative. The forms round u relative to c; if the posterior is many
decades below the prior, |u|^2 is lost in that rounding, and refined solutions keep its digits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, special

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from .estimator.certificate import exact_sums, refine
from .estimator.residuals import ExactResiduals, exact
from .problem import Form

Pixels = NDArray[np.intp]

STIFF = 1e-14  # posterior over prior variance, below which the rounding of u relative to c matters
LEAST_ACCURACY = 1e-3  # of the error bar of a sum, relative
CHUNK = 512  # pixels solved for at once
COVERAGE = (0.005, 0.995)  # quantiles of the interval


def variance_of_sum(form: Form, weights: FloatArray, noise_variance: FloatArray) -> float:
    """Return the expected squared error (Eq. 5) of a weighted sum of pixels; weights : (N,), such as 1/n in a region.

    Errors of neighbours are correlated, so this is not the sum of their variances.
    Raises InputError if the sum of squares and the quadratic form c^T u of Eq. 5 differ, or if that one is uncertain.
    """
    problem, residuals = form.problem, ExactResiduals(form.problem)
    shift = residuals.root_transposed(exact(weights[:, None]))
    refined = refine(form, residuals, shift)
    prior, squares = float(np.square(refined.coefficients).sum()), np.square(refined.multipliers[:, 0])
    variance = prior + float(noise_variance @ squares)
    expected, bound = (float(values[0]) for values in exact_sums(form, residuals, shift))
    ratio = np.divide(
        noise_variance,
        problem.noise_variance,
        out=np.ones_like(noise_variance, dtype=np.float64),
        where=problem.noise_variance > 0,
    )
    error = abs(prior + float(problem.noise_variance @ squares) - expected) + bound
    error *= max(1.0, float(ratio.max(initial=1.0)))
    if not error <= LEAST_ACCURACY * variance and error > 0:
        raise InputError(
            f"the error bar of a sum of pixels is lost in rounding ({variance:.1e} +- {error:.1e}); raise"
            " estimator.noise_variance"
        )
    return expected if np.array_equal(noise_variance, problem.noise_variance) else variance


def bias_of(form: Form, difference: FloatArray) -> FloatArray:
    """Return (I - A H) d, (N,), of an image less the prior's mean, without the cancellation of d and A H d.

    With d = L c + e, it is L u + e - A H e, where u solves for c and r = 0; e is 0 or the rounding error of L c.
    """
    prior = form.problem.prior
    deviation: FloatArray = np.zeros(prior.dimension)
    with np.errstate(all="ignore"):
        if prior.independent:
            deviation = np.divide(difference, prior.root, out=np.zeros_like(difference), where=prior.root > 0)
        elif prior.root.shape[0] == prior.root.shape[1]:
            try:
                deviation = np.asarray(np.linalg.solve(prior.root, difference), dtype=np.float64)
            except np.linalg.LinAlgError:
                deviation = np.zeros(prior.dimension)
    rest = difference - prior.apply_root(deviation)
    if not np.isfinite(rest).all() or np.linalg.norm(rest) > np.linalg.norm(difference):
        deviation, rest = np.zeros(prior.dimension), difference
    refined = refine(form, ExactResiduals(form.problem), exact(deviation[:, None]))
    return prior.apply_root(refined.coefficients[:, 0]) + rest - form.gain(form.problem.matrix @ rest)


@dataclass(frozen=True)
class ExpectedError:
    """Eq. 5: (N,) `variance` of every pixel, and the parts of its mean that the prior and each noise bring.

    missing : the prior's part, in run.json "null_space": unseen by the measurements, or hidden by their noise
    resolved : (N,), the diagonal of A H: the share of a pixel's value that comes from the measurements, 0 to 1
    leverage : (M,), the diagonal of H A, where all pixels were solved for; None where it is not known
    attenuation : mean squared error that the errors of H add by drawing the estimate towards no contrast; None where
        it was not computed;  second_order : the next order of the errors of H relative to that
    """

    variance: FloatArray
    missing: float
    parts: dict[str, float]
    resolved: FloatArray
    leverage: FloatArray | None = None
    attenuation: float | None = None
    second_order: float = 0.0

    @property
    def mse(self) -> float:
        """Expected squared error, averaged over the pixels."""
        return float(self.variance.mean())

    @property
    def degrees_of_freedom(self) -> float:
        """Trace of A H: the number of independent values that the measurements determine (Rodgers 2000, 2.4)."""
        return float(self.resolved.sum())

    @property
    def resolution(self) -> FloatArray:
        """Width of the averaging kernel in pixels of f, (N,): 1 / sqrt((A H)_ii), infinite where nothing is seen.

        The side of the square of pixels that share one degree of freedom (after Purser and Huang 1993).
        """
        root = np.sqrt(np.maximum(self.resolved, 0.0))
        return np.divide(1.0, root, out=np.full_like(root, np.inf), where=root > 0)

    @property
    def median_width(self) -> float | None:
        """Median of `resolution`, None where nothing is resolved."""
        width = float(np.median(self.resolution))
        return width if isfinite(width) else None


@dataclass(frozen=True)
class Interval:
    """Expectation of the mean squared error given the image, and the interval that holds it in 99 of 100 cases.

    variance : of the mean squared error, a gamma variate; 0 where it is certain
    """

    mse: float
    low: float
    high: float
    variance: float = 0.0

    def with_added(self, mean: float, variance: float, count: int) -> Interval:
        """Return the interval with another error, whose sum over `count` pixels has this mean and variance."""
        return interval(max(count * self.mse + mean, 0.0), count**2 * self.variance + variance, count)


def expected_error(form: Form, noise: dict[str, FloatArray], pixels: Pixels | None = None) -> ExpectedError:
    """Return Eq. 5 for the actual noise.

    noise : named (M,) variances, the diagonal of Rvm in parts;  pixels : whose error is returned, absent: all
    """
    problem = form.problem
    pixels = np.arange(problem.unknowns) if pixels is None else pixels
    count, measurements = pixels.size, problem.measurements
    by_column = sparse.csc_array(problem.matrix)
    total = np.sum(list(noise.values()), axis=0) if noise else np.zeros(measurements)
    missing, noisy, resolved = np.zeros(count), np.zeros(count), np.zeros(count)
    weights, leverage = np.zeros(measurements), np.zeros(measurements)
    for chunk, chosen, u, negative in solved_columns(form, pixels):
        missing[chunk] = np.square(u).sum(axis=0)
        products = by_column[:, chosen].multiply(negative)
        resolved[chunk] = -np.asarray(products.sum(axis=0)).ravel()
        leverage -= np.asarray(products.sum(axis=1)).ravel()
        squared = np.square(negative)
        noisy[chunk] = total @ squared
        weights += squared.sum(axis=1) / count
    as_expected = np.array_equal(total, problem.noise_variance)
    variance = form.variance()[pixels] if as_expected else missing + noisy
    parts = {name: float(weights @ values) for name, values in noise.items()}
    all_pixels = count == problem.unknowns
    return ExpectedError(variance, float(missing.mean()), parts, resolved, leverage if all_pixels else None)


def expected_given(form: Form, truth: FloatArray, noise_variance: FloatArray) -> Interval:
    """Return the expected mean squared error for one image: |(I - A H)(f - f0)|^2 + trace(A Rvm A^T), over N.

    Use it for a photograph, which is no draw from the prior of Eq. 5.
    """
    bias = bias_of(form, truth - form.problem.prior.mean)[:, None]
    mean, variance = squared_error(form, bias, noise_variance, np.arange(truth.size))
    return interval(float(mean[0]), float(variance[0]), truth.size)


def squared_error(
    form: Form, bias: FloatArray, noise_variance: FloatArray, pixels: Pixels
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of the sum of squared errors of some pixels, (t,) each, for the biases of t images.

    With K = A Rvm A^T of these pixels, the quadratic form |b|^2 + trace(K) has the variance 4 b^T K b + 2 trace(K^2).

    bias : (pixels, t) (I - A H)(f - f0);  noise_variance : (M,)
    """
    trace = squares = 0.0
    along = np.zeros(bias.shape[1])
    for chunk, _, _, negative in solved_columns(form, pixels):
        weighted = noise_variance[:, None] * negative
        covariance = -form.gain(weighted)[pixels]
        trace += float(np.sum(weighted * negative))
        squares += float(np.square(covariance).sum())
        along += np.sum((covariance.T @ bias) * bias[chunk], axis=0)
    return np.square(bias).sum(axis=0) + trace, 4 * along + 2 * squares


def interval(mean: float, variance: float, count: int) -> Interval:
    """Return the interval of the mean of `count` squares, whose sum is a gamma variate of this mean and variance."""
    if variance <= 0:
        return Interval(mean / count, mean / count, mean / count)
    shape, scale = mean**2 / variance, variance / mean
    low, high = (float(special.gammaincinv(shape, level)) * scale for level in COVERAGE)
    return Interval(mean / count, low / count, high / count, variance / count**2)


def solved_columns(form: Form, pixels: Pixels) -> Iterator[tuple[slice, Pixels, FloatArray, FloatArray]]:
    """Yield for chunks of pixels their range, indices, u, (K, q), whose squares are the prior's part, and -A^T e_i.

    They are refined where posterior variances are so far below the prior's that rounding would hide them.
    """
    is_stiff = (form.variance() < STIFF * form.problem.prior.variance).any()
    residuals = ExactResiduals(form.problem) if is_stiff else None
    for start in range(0, pixels.size, CHUNK):
        chunk = slice(start, min(start + CHUNK, pixels.size))
        chosen = pixels[chunk]
        if residuals is None:
            u, negative = form.pixel_solutions(chosen)
        else:
            refined = refine(form, residuals, exact(form.problem.pixel_shift(chosen)))
            u, negative = refined.coefficients, refined.multipliers
        yield chunk, chosen, u, negative
