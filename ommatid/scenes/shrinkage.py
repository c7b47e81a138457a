"""Shrinkage of sample variances from few repeats, each of which alone would be a poor weight."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import ndimage, optimize, special

from ommatid.runtime.arrays import FloatArray

FEW = 0.1  # share of the quantities that varied, below which they are rare events
MANY = 1000  # that varied, from which their distribution shows that of the true variances
GROUP_SIZE = 2000  # fewest quantities with similar neighbours that are taken together
MOST_GROUPS = 24
STEP = 0.0625  # of the logarithm, in standard deviations of that of a sample variance
KERNEL = 4  # steps: standard deviation of the kernel that smooths their distribution
CONTRAST_GROUP = 200  # fewest pixels of similar contrast whose variances are shrunk together
LEAST_FREEDOM = 10  # of a sample variance, below which passes are too few for that


def posterior_variances_among(variance: FloatArray, likely: FloatArray, repeats: int) -> FloatArray:
    """Posterior means of true variances, (n,), each among those of which `likely`, (n,), says about the same.

    likely : increases with the expected true variance, and does not depend on the sample variance of its own quantity
    """
    means = np.empty_like(variance)
    groups = max(1, min(variance.size // GROUP_SIZE, MOST_GROUPS))
    for group in np.array_split(np.argsort(likely), groups):
        means[group] = posterior_variances(variance[group], repeats)
    return means


def posterior_variances(variance: FloatArray, repeats: int) -> FloatArray:
    """Posterior means of true variances, as `shrink_variances`, but where there are many without a form for their law.

    A sample variance x of v degrees of freedom is the true one times a chi-squared variate over v. If f is the density
    of all sample variances, the mean of the true ones at x is, whatever their distribution (after Robbins 1956, Third
    Berkeley Symposium 1, 157, for the scale of a gamma variate),

        (v / 2) x^(v/2 - 1) / f(x) times the integral of t^(1 - v/2) f(t) from x to infinity.
    """
    known = variance > 0
    freedom = repeats - 1
    if int(known.sum()) < MANY or freedom < LEAST_FREEDOM:
        return shrink_variances(variance, repeats)
    logarithms = np.log(variance[known])
    step = STEP * (2 / freedom) ** 0.5
    numbers = 3 * KERNEL + ((logarithms - logarithms.min()) / step).astype(np.intp)
    counts = np.bincount(numbers, minlength=int(numbers.max()) + 1 + 3 * KERNEL).astype(np.float64)
    middles = logarithms.min() + step * (np.arange(counts.size) - 3 * KERNEL + 0.5)
    density = ndimage.gaussian_filter1d(counts, KERNEL, mode="constant", truncate=3)
    # The integral from one bin on is that from the next on, times e^(1 - v/2) per unit of the logarithm, and its own.
    ratio = float(np.exp((1 - freedom / 2) * step))
    above, beyond = np.empty_like(density), 0.0
    for index in range(density.size - 1, -1, -1):
        above[index] = beyond = float(density[index]) + ratio * beyond
    above -= density / 2
    shrinkage = np.divide(freedom / 2 * step * above, density, out=np.zeros_like(above), where=density > 0)
    # Where the density is small it is uncertain, and the means rise: neighbours are averaged until they do.
    rising = optimize.isotonic_regression(
        np.exp(middles - middles[0]) * shrinkage, weights=np.maximum(density, np.finfo(float).tiny)
    )
    means = np.exp(middles[0]) * np.asarray(rising.x)
    result = shrink_variances(variance, repeats)
    result[known] = np.interp(logarithms, middles, means)
    return result


def shrink_variances(variance: FloatArray, repeats: int) -> FloatArray:
    """Posterior means of true variances, given the sample variances of `repeats` values of each of similar quantities.

    The true variances are taken as draws from a scaled inverse chi-squared distribution whose two parameters are
    fitted to the logarithms (Smyth 2004, Statistical Applications in Genetics and Molecular Biology 3, article 3): the
    scatter of the logarithms in excess of that of so few repeats is real. Each variance shrinks towards a typical one,
    not towards the arithmetic mean, which would give flat parts of a picture the variance of its edges. Posterior means
    keep sums of variances unbiased even when the variances were used as weights. Where few quantities varied at all, by
    rare events, the others keep the variance 0; where many did, stratified samples have hidden that of the others.
    """
    freedom = repeats - 1
    known = variance > 0
    if known.sum() < 2:
        return variance
    logarithms = np.log(variance[known])
    others = known if float(known.mean()) < FEW else np.ones_like(known)
    excess = float(logarithms.var(ddof=1)) - _trigamma(freedom / 2)
    centre = float(logarithms.mean() - special.digamma(freedom / 2)) + np.log(freedom / 2)
    if excess <= 0:  # no sign of unequal variances
        return np.where(others, np.exp(centre), 0.0)
    weight = 2 * _inverse_trigamma(excess)
    typical = np.exp(centre + special.digamma(weight / 2) - np.log(weight / 2))
    return np.where(others, (weight * typical + freedom * variance) / (weight + freedom - 2), 0.0)


def _trigamma(x: float) -> float:
    return float(special.polygamma(1, x))


def _inverse_trigamma(value: float) -> float:
    # Trigamma falls from infinity to 0; in the logarithm of x this bracket holds the root of every float.
    def difference(logarithm: float) -> float:
        return _trigamma(float(np.exp(logarithm))) - value

    return float(np.exp(cast(Any, optimize).brentq(difference, -30.0, 30.0)))


def shrunk_by_contrast(
    variance: FloatArray, scatter: FloatArray, excess: FloatArray, slices: list[slice], repeats: int
) -> FloatArray:
    """Return the variances of measurements from their scatter, shrunk among pixels of a lens type with like contrast.

    variance : (M,) as if errors of entries were independent, which rises with contrast, 0 where H is certain
    scatter, excess : (M,) sample variances of few repeats, and the part of them that noise in the image explains
    """
    variance = variance.copy()
    for pixels in slices:
        uncertain = pixels.start + np.flatnonzero(variance[pixels] > 0)
        by_contrast = uncertain[np.argsort(variance[uncertain])]
        for group in np.array_split(by_contrast, max(1, min(uncertain.size // CONTRAST_GROUP, MOST_GROUPS))):
            if group.size:
                variance[group] *= shrink_variances(scatter[group] / variance[group], repeats)
                # Ratios of flat pixels have long tails, whose posterior means do not add up to the scatter.
                total = max(float(scatter[group].sum() - excess[group].sum()), 0.0)
                variance[group] *= total / (float(variance[group].sum()) or 1.0)
    return variance
