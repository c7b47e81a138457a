"""The minimum-variance estimate (Wood et al., Eq. 4): which form computes it, and how right it is.

With g = H f + v, prior mean f0 and covariance P0, and noise covariance Rv,

    f^ = f0 + A (g - H f0),   A = P0 H^T (H P0 H^T + Rv)^-1.                      (Eq. 4)

Six forms compute it (`forms`). The cheapest that suits shape and noise runs first; when the bound on its error, or that
on its variances, misses the tolerance, the next sturdier one runs. What no form can do is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log10

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import free_memory

from ..forms.covariance import covariance
from ..forms.dual import dual
from ..forms.form import Form, NotSolvableError, Vector
from ..forms.information import information
from ..forms.square_root_covariance import square_root_covariance
from ..forms.square_root_information import square_root_information
from ..forms.svd import svd
from ..problem import Problem
from .certificate import RefinedSolution, refine, variance_error
from .memory import needed_memory
from .refined_form import RefinedForm
from .residuals import ExactResiduals

TOLERANCE = 1e-8
LEAST_DIGITS = 1.0  # that the condition must leave for a form with squares to be worth a try
EPS = float(np.finfo(np.float64).eps)
CONTRADICTION = 1e-6  # of the measurements: float32 files hold no more
USEFUL = 1e-3  # bound of an estimate that tells whether measurements without noise are met
SOMEHOW = 10.0  # a bound above it says that u is not known at all, and so not what contradicts what
WIDE = 1e12  # ratio of the largest to the least noise variance from which on the SVD loses what the noisy rows say

FORMS: dict[str, Callable[[Problem], Form]] = {
    "covariance": covariance,
    "information": information,
    "square-root-information": square_root_information,
    "square-root-covariance": square_root_covariance,
    "svd": svd,
    "dual": dual,
}


@dataclass(frozen=True)
class Solver:
    """Which form ran, why, and how right it is.

    bound : of the error of the estimate, in `unit`; None where nothing was estimated
    variance_bound : of the relative error of posterior variances, on pixels chosen to show it
    tried : forms that ran or were passed over before, with the reason
    """

    method: str
    why: str
    condition: float
    variance_bound: float
    tried: tuple[tuple[str, str], ...] = ()
    bound: float | None = None
    refinements: int = 0
    unit: str = "standard deviation of the prior"

    @property
    def digits(self) -> float:
        """Decimal digits of the estimate that the bound vouches for."""
        return -log10(max(self.bound if self.bound is not None else self.variance_bound, EPS))


@dataclass(frozen=True)
class Estimate:
    """The image f^, (N,), the multipliers l = Rv^-1 (g - H f^), (M,), and the form with which they were found.

    freedoms : (K,) u of f^ = f0 + L u, which f^ itself does not show where L u is far below f0
    """

    image: Vector
    freedoms: Vector
    multipliers: Vector
    form: Form
    solver: Solver


def candidates(problem: Problem, method: str = "auto") -> tuple[list[str], str]:
    """Forms to try, the cheapest first, and in words why these."""
    if method != "auto":
        return [method], "asked for"
    if not problem.noisy:
        return ["dual"], "some measurements have no noise"
    noise, sizes = problem.noise_variance, (problem.measurements, problem.prior.freedoms)
    # Where the information form fails, H has a null space that the covariance form does not mind.
    first = ["covariance"] if sizes[0] < sizes[1] else ["information", "covariance"]
    why = "fewer measurements than unknowns" if sizes[0] < sizes[1] else "no fewer measurements than unknowns"
    if noise.size and noise.max() > WIDE * noise.min():
        apart = f"noise variances {noise.max() / noise.min():.0e} apart"
        return [*first, "square-root-information", "dual"], f"{why}, {apart}"
    arrays = ["square-root-covariance"] if sizes[0] < sizes[1] else []
    return [*first, "svd", *arrays, "square-root-information", "dual"], why


def factorise(problem: Problem, method: str = "auto", tolerance: float = TOLERANCE) -> tuple[Form, Solver]:
    """The form whose posterior variances are right to `tolerance`. Raises InputError if there is none."""
    form, solver, _ = _first_good(problem, method, tolerance, None)
    return form, solver


def estimate(problem: Problem, recorded: Vector, method: str = "auto", tolerance: float = TOLERANCE) -> Estimate:
    """Reconstruct the image with the least mean squared error of any linear estimator (Eq. 4).

    recorded : (M,) g, in the units of f
    Raises InputError for numbers that are none, if memory does not suffice, or if no form is right to `tolerance`.
    """
    if recorded.shape != (problem.measurements,) or not np.isfinite(recorded).all():
        raise InputError(
            f"expected {problem.measurements} finite measurements, got others; leave dead pixels out first"
        )
    form, solver, refined = _first_good(problem, method, tolerance, recorded)
    if refined is None:
        raise RuntimeError("measurements were given, and nothing was estimated from them")
    image = problem.prior.mean + problem.prior.spread(refined.freedoms[:, 0])
    return Estimate(image, refined.freedoms[:, 0], refined.multipliers[:, 0], form, solver)


def _first_good(
    problem: Problem, method: str, tolerance: float, recorded: Vector | None
) -> tuple[Form, Solver, RefinedSolution | None]:
    names, why = candidates(problem, method)
    exactly = ExactResiduals(problem)
    tried: list[tuple[str, str]] = []
    refined: RefinedSolution | None = None
    solver = Solver("", why, 0.0, 0.0)
    worth: list[Form] = []  # correcting, since the estimate is right and only variances are not
    for name in names:
        try:
            form = _built(name, problem)
        except NotSolvableError as error:
            tried.append((name, str(error)))
            continue
        solver = Solver(name, why, form.condition, variance_error(form, exactly), tuple(tried))
        solver, refined = _with_estimate(solver, form, exactly, recorded)
        if _accepted(solver, tolerance, tried):
            return form, solver, refined
        if (solver.bound or 0.0) <= tolerance:
            worth.append(form)
    for form in reversed(worth if method == "auto" else []):
        corrected = RefinedForm(problem, form.condition, form, exactly)
        solver = Solver(f"{form.name}, corrected", why, form.condition, corrected.variance_error, tuple(tried))
        solver, refined = _with_estimate(solver, form, exactly, recorded)
        if _accepted(solver, tolerance, tried):
            return corrected, solver, refined
    if refined is not None and recorded is not None and (solver.bound or 0.0) < SOMEHOW:
        _refuse_contradictions(exactly, recorded, refined)
    raise InputError(
        f"no form of the estimator reaches a relative error of {tolerance:g} here ("
        + "; ".join(f"{name}: {reason}" for name, reason in tried)
        + "); raise estimator.noise_variance or estimator.tolerance"
    )


def _with_estimate(
    solver: Solver, form: Form, exactly: ExactResiduals, recorded: Vector | None
) -> tuple[Solver, RefinedSolution | None]:
    if recorded is None:
        return solver, None
    refined = refine(form, exactly, np.zeros((form.problem.prior.freedoms, 1)), exactly.recorded(recorded))
    bound = float(refined.bound[0]) + EPS
    if bound <= USEFUL:
        _refuse_contradictions(exactly, recorded, refined)
    return replace(solver, bound=bound, refinements=refined.steps), refined


def _accepted(solver: Solver, tolerance: float, tried: list[tuple[str, str]]) -> bool:
    worst = max(solver.variance_bound, solver.bound or 0.0)
    if worst > tolerance:
        what = "variances" if solver.variance_bound > tolerance else "the estimate"
        tried.append((solver.method, f"{what} right to {worst:.1e} only"))
    return worst <= tolerance


def _refuse_contradictions(exactly: ExactResiduals, recorded: Vector, refined: RefinedSolution) -> None:
    left = exactly.contradiction(recorded, refined.freedoms[:, 0])
    if left > CONTRADICTION:
        raise InputError(
            f"measurements that are said to have no noise contradict one another or the prior by {left:.2g} of their"
            " values; set estimator.noise_variance to what noise they have"
        )


def _built(name: str, problem: Problem) -> Form:
    sizes, correlated = (problem.measurements, problem.unknowns), not problem.prior.independent
    needed, free = needed_memory(name, *sizes, correlated=correlated), free_memory()
    if needed > free:
        raise NotSolvableError(f"it needs {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free")
    with np.errstate(all="ignore"):  # what overflows is caught by the certificate
        form = FORMS[name](problem)
    if name in ("covariance", "information") and form.condition * EPS > 10**-LEAST_DIGITS:
        raise NotSolvableError(f"a condition of {form.condition:.1e} leaves no digits")
    return form
