"""Shrinkage of sample variances from few repeats, each of which alone would be a poor weight."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import optimize, special

from ommatid.runtime.arrays import FloatArray

FEW = 0.1  # share of the quantities that varied, below which they are rare events


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
