"""Variances from few repeats, moderated: each alone is a poor weight, all together say how far each can be trusted."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

Vector = NDArray[np.float64]


def shrink_variances(variance: Vector, repeats: int) -> Vector:
    """The expected true variances, given the sample variances of `repeats` values each, of things of one kind.

    The true variances are taken as draws from a scaled inverse chi-squared distribution whose two parameters are
    fitted to the logarithms (Smyth 2004, Statistical Applications in Genetics and Molecular Biology 3, article 3):
    what these scatter more than so few repeats make them is real. Each variance is drawn towards a typical one, not
    towards the arithmetic mean, which would give flat parts of a picture the variance of its edges. The mean of what
    remains possible is taken, so that sums of variances come out right even when they were used as weights.
    """
    freedom = repeats - 1
    known = variance > 0
    if known.sum() < 2:
        return variance
    logarithms = np.log(variance[known])
    excess = float(logarithms.var(ddof=1)) - _trigamma(freedom / 2)
    centre = float(logarithms.mean() - special.digamma(freedom / 2)) + np.log(freedom / 2)
    if excess <= 0:  # all alike
        return np.full_like(variance, np.exp(centre))
    weight = 2 * _inverse_trigamma(excess)
    typical = np.exp(centre + special.digamma(weight / 2) - np.log(weight / 2))
    return (weight * typical + freedom * variance) / (weight + freedom - 2)


def _trigamma(x: float) -> float:
    return float(special.polygamma(1, x))


def _inverse_trigamma(value: float) -> float:
    # It falls from infinity to 0; in the logarithm of x a bracket that holds every float is short.
    def away(logarithm: float) -> float:
        return _trigamma(float(np.exp(logarithm))) - value

    return float(np.exp(cast(Any, optimize).brentq(away, -30.0, 30.0)))
