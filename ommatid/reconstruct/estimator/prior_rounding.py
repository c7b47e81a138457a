"""What the rounding of a correlated prior's covariance changes: the estimate, and its posterior variances.

The certificate takes the root L as exact. With the error E of L L^T as an approximation of P0, to first order,

    df = (I - A H) E H^T l,    dV_i = ((I - A H) E (I - A H)^T)_ii,

where |E_ij| is some epsilon of the prior's standard deviations. Its signs are drawn at random. It matters where P0 is
nearly singular: pixels that are correlated over a million pixels differ by less than the rounding of their variance.
"""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray

from ..forms.form import Form
from .error_norms import norms, sampled_pixels

DRAWS = 4
MARGIN = 2.0  # times the standard deviation of dV_i


def estimate_rounding(form: Form, u: FloatArray, multipliers: FloatArray) -> float:
    """Return |df| in standard deviations of the prior, relative to |u|; u : (K,), multipliers : (M,)."""
    problem = form.problem
    deviation = np.sqrt(problem.prior.variance)
    if not problem.prior.rounding or not u.any():
        return 0.0
    with np.errstate(all="ignore"):
        pull = float(norms((deviation * (problem.matrix.T @ multipliers))[:, None])[0])
        signs = np.random.default_rng(4).choice([-1.0, 1.0], (problem.unknowns, DRAWS))
        change = problem.prior.rounding * pull * deviation[:, None] * signs
        change -= form.gain(problem.matrix @ change)
        whitened = np.divide(change, deviation[:, None], out=np.zeros_like(change), where=deviation[:, None] > 0)
        return float(norms(whitened).max() / norms(u[:, None])[0])


def variance_rounding(form: Form) -> float:
    """Return the largest dV_i / V_i of a sample of pixels."""
    problem = form.problem
    if not problem.prior.rounding:
        return 0.0
    variance = form.variance()
    pixels = sampled_pixels(variance, problem.prior.variance)
    pixels = pixels[variance[pixels] > 0]
    with np.errstate(all="ignore"):
        _, negative = form.pixel_solutions(pixels)
        unresolved = problem.matrix.T @ negative
        unresolved[pixels, np.arange(pixels.size)] += 1.0
        squares = problem.prior.variance @ np.square(unresolved)
        return float((MARGIN * problem.prior.rounding * squares / variance[pixels]).max(initial=0.0))
