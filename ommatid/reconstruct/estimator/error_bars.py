"""Solutions for error bars, refined where rounding would outweigh them.

Error bars are sums |u|^2 + l^T Rvm l of solutions for r = 0. The forms round u relative to c; if the posterior is many
decades below the prior, |u|^2 is lost in that rounding. Refined solutions keep their digits.
"""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..forms.form import Form
from .certificate import exact_sums, refine
from .double_double import exact
from .refined_form import RefinedForm
from .residuals import ExactResiduals

STIFF = 1e-14  # posterior over prior variance, below which the rounding of u relative to c matters
LEAST_ACCURACY = 1e-3  # of the error bar of a sum, relative


def is_stiff(form: Form) -> bool:
    """Return True if a posterior variance is so far below the prior's that solutions need refinement."""
    prior = form.problem.prior.variance
    return bool((form.variance() < STIFF * prior).any())


def refined_solutions(form: Form, residuals: ExactResiduals, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve for c = `shift`, (K, q), and r = 0 with refinement: u, (K, q), and l, (M, q)."""
    zero = np.zeros((form.problem.measurements, shift.shape[1]))
    if isinstance(form, RefinedForm):
        return form.solve(shift, zero)
    refined = refine(form, residuals, shift, exact(zero))
    return refined.coefficients, refined.multipliers


def sum_variance(form: Form, weights: FloatArray, noise_variance: FloatArray) -> float:
    """Return the expected squared error (Eq. 5) of a weighted sum of pixels; weights : (N,).

    Raises InputError if the sum of squares and the quadratic form c^T u of Eq. 5 differ, or if that one is uncertain.
    """
    problem, residuals = form.problem, ExactResiduals(form.problem)
    inner = form.form if isinstance(form, RefinedForm) else form
    shift = residuals.root_transposed(exact(weights[:, None]))
    refined = refine(inner, residuals, shift, exact(np.zeros((problem.measurements, 1))))
    prior, squares = float(np.square(refined.coefficients).sum()), np.square(refined.multipliers[:, 0])
    variance = prior + float(noise_variance @ squares)
    expected, bound = (float(values[0]) for values in exact_sums(inner, residuals, shift))
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
    u, _ = refined_solutions(form, ExactResiduals(form.problem), deviation[:, None])
    return prior.apply_root(u[:, 0]) + rest - form.gain(form.problem.matrix @ rest)
