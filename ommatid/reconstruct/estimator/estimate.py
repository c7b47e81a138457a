"""The minimum-variance estimate (Wood et al. 2005, Eq. 4) by one certified solver.

With g = H f + v, prior mean f0 and covariance P0, and noise covariance Rv,

    f^ = f0 + A (g - H f0),   A = P0 H^T (H P0 H^T + Rv)^-1.                      (Eq. 4)

Three implementations compute it (`forms`): Cholesky, of either side, is fast; the square-root form squares nothing;
the dual form is slow and admits measurements without noise. The Cholesky of the smaller side runs first. If the bound
on the error of the estimate or of its variances exceeds the tolerance, the next form runs; if none succeeds,
InputError is raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import free_memory

from ..forms.cholesky import covariance, information
from ..forms.dual import dual
from ..forms.square_root import square_root
from ..output.run_json import RejectedForm, SolverReport
from ..problem import Form, NotSolvableError, Problem
from .certificate import RefinedSolution, estimate_rounding, refine, variance_error, variance_rounding
from .residuals import DoubleDouble, ExactResiduals, exact

TOLERANCE = 1e-8
LEAST_DIGITS = 1.0  # digits that the condition number must leave to a form that squares the matrix
EPS = float(np.finfo(np.float64).eps)
CONTRADICTION = 1e-6  # relative misfit of noise-free measurements; the precision of float32 files
USEFUL_BOUND = 1e-3  # bound below which an estimate shows whether noise-free measurements are met
UNKNOWN_BOUND = 10.0  # bound above which u is unknown, and with it which measurements contradict
FORMS: dict[str, Callable[[Problem], Form]] = {
    "information": information,
    "covariance": covariance,
    "square-root": square_root,
    "dual": dual,
}


def needed_memory(measurements: int, unknowns: int, *, correlated: bool = False) -> int:
    """Return the bytes that the first form and its error analysis need."""
    return _memory("covariance" if measurements < unknowns else "information", measurements, unknowns, correlated)


def _memory(form: str, measurements: int, unknowns: int, correlated: bool) -> int:
    """Return the bytes that a form needs; a `correlated` prior adds its root and copies of it."""
    both = measurements + unknowns
    matrix = {
        "covariance": 3 * measurements**2 + 2 * measurements * unknowns + 2 * unknowns**2,
        "information": 7 * unknowns**2,
        "square-root": 4 * both * unknowns + 2 * unknowns**2,
        "dual": 5 * measurements * both + 4 * both * unknowns,
    }
    return 8 * (matrix[form] + (4 * unknowns**2 if correlated else 0))


@dataclass(frozen=True)
class Estimate:
    """The image f^, (N,), the multipliers l = Rv^-1 (g - H f^), (M,), and the form that computed them.

    coefficients : (K,) u of f^ = f0 + L u, which keeps digits that f^ loses if L u is far below f0
    residuals : of the problem, for the next estimate with the same form
    """

    image: FloatArray
    coefficients: FloatArray
    multipliers: FloatArray
    form: Form
    solver: SolverReport
    residuals: ExactResiduals


def estimate(
    problem: Problem, recorded: FloatArray, tolerance: float = TOLERANCE, before: Estimate | None = None
) -> Estimate:
    """Reconstruct the image with the least mean squared error of any linear estimator (Eq. 4).

    recorded : (M,) g, in the units of f
    before : an estimate from other measurements with the same H, prior and noise, whose form is tried first
    Raises InputError for values that are not finite, if memory does not suffice, or if no form reaches `tolerance`.
    """
    problem.check(recorded)
    residuals = ExactResiduals(problem) if before is None else before.residuals
    form, solver, refined = _by_form_of(before, tolerance, recorded) or _certified(residuals, tolerance, recorded)
    multipliers = refined.multipliers[:, 0]
    with np.errstate(all="ignore"):
        image = residuals.image(DoubleDouble(refined.coefficients, refined.low)).high[:, 0]
    if not (np.isfinite(image).all() and np.isfinite(multipliers).all()):
        raise InputError(
            "the estimate or its multipliers leave the range of double precision; scale H, or raise"
            " estimator.noise_variance"
        )
    return Estimate(image, refined.coefficients[:, 0], multipliers, form, solver, residuals)


def _by_form_of(
    before: Estimate | None, tolerance: float, recorded: FloatArray
) -> tuple[Form, SolverReport, RefinedSolution] | None:
    """Return the estimate by the form of another one, None where that form does not reach the tolerance."""
    if before is None:
        return None
    solver, refined = _with_estimate(before.solver, before.form, before.residuals, recorded)
    return (before.form, solver, refined) if _failure(solver, tolerance) is None else None


def _chain(problem: Problem) -> tuple[list[str], str]:
    """Names of the forms to try, the cheapest first, and the reason for them."""
    if not problem.noisy:
        return ["dual"], "some measurements have no noise"
    if problem.measurements < problem.prior.dimension:
        return ["covariance", "square-root", "dual"], "fewer measurements than unknowns"
    # If the information form fails, H has a null space, which the covariance form tolerates.
    return ["information", "covariance", "square-root", "dual"], "no fewer measurements than unknowns"


def _certified(
    residuals: ExactResiduals, tolerance: float, recorded: FloatArray
) -> tuple[Form, SolverReport, RefinedSolution]:
    """Return the first form that reaches the tolerance, its report, and the estimate."""
    names, why = _chain(residuals.problem)
    tried: list[RejectedForm] = []
    solver: SolverReport | None = None
    refined: RefinedSolution | None = None
    for name in names:
        try:
            form = _factorised(name, residuals.problem)
            solver = _with_variances(form, why, residuals, tolerance)
            solver, refined = _with_estimate(solver, form, residuals, recorded)
        except (NotSolvableError, np.linalg.LinAlgError) as error:
            tried.append(RejectedForm(method=name, why_not=str(error)))
            continue
        failure = _failure(solver, tolerance)
        if failure is None:
            return form, solver.model_copy(update={"tried": tuple(tried)}), refined
        tried.append(RejectedForm(method=name, why_not=failure))
    known = solver is not None and solver.bound is not None and solver.bound < UNKNOWN_BOUND
    if refined is not None and known:
        _check_contradictions(residuals, recorded, refined)
    raise InputError(
        f"no form of the estimator reaches a relative error of {tolerance:g} here ("
        + "; ".join(f"{form.method}: {form.why_not}" for form in tried)
        + "); raise estimator.noise_variance or estimator.tolerance"
    )


def _factorised(name: str, problem: Problem) -> Form:
    needed = _memory(name, problem.measurements, problem.unknowns, correlated=not problem.prior.independent)
    free = free_memory()
    if needed > free:
        raise NotSolvableError(f"it needs {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free")
    with np.errstate(all="ignore"):  # the certificate detects overflow
        form = FORMS[name](problem)
    if name in ("information", "covariance") and form.condition * EPS > 10**-LEAST_DIGITS:
        raise NotSolvableError(f"a condition number of {form.condition:.1e} leaves no digits")
    return form


def _with_variances(form: Form, why: str, residuals: ExactResiduals, tolerance: float) -> SolverReport:
    """Report on a form before any estimate. Raises InputError if the rounding of P0 alone exceeds the tolerance."""
    error, rounding = variance_error(form, residuals), variance_rounding(form)
    if error <= tolerance < rounding:
        raise InputError(
            f"the prior's covariance is so nearly singular that its rounding changes variances by {rounding:.1e},"
            f" relative, where {tolerance:g} is allowed; shorten prior.correlation_length, or raise estimator.tolerance"
        )
    return SolverReport(
        way="",
        method=form.name,
        why=why,
        condition=form.condition if isfinite(form.condition) else None,
        bound=None,
        unit="standard deviation of the prior",
        variance_bound=error + rounding,
        refinements=0,
    )


def _with_estimate(
    solver: SolverReport, form: Form, residuals: ExactResiduals, recorded: FloatArray
) -> tuple[SolverReport, RefinedSolution]:
    with np.errstate(all="ignore"):
        deviation = residuals.recorded(recorded)
    refined = refine(form, residuals, exact(np.zeros((form.problem.prior.dimension, 1))), deviation)
    bound = float(refined.bound[0]) + EPS
    bound += estimate_rounding(form, refined.coefficients[:, 0], refined.multipliers[:, 0])
    if bound <= USEFUL_BOUND:
        _check_contradictions(residuals, recorded, refined)
    return solver.model_copy(update={"bound": bound, "refinements": refined.steps}), refined


def _failure(solver: SolverReport, tolerance: float) -> str | None:
    """Return which of the two bounds exceeds the tolerance, None where neither does; NaN does."""
    if not solver.variance_bound <= tolerance:
        return f"variances are accurate to {solver.variance_bound:.1e} only"
    if solver.bound is not None and not solver.bound <= tolerance:
        return f"the estimate is accurate to {solver.bound:.1e} only"
    return None


def _check_contradictions(residuals: ExactResiduals, recorded: FloatArray, refined: RefinedSolution) -> None:
    with np.errstate(all="ignore"):
        misfit = residuals.contradiction(recorded, DoubleDouble(refined.coefficients, refined.low))
    if misfit > CONTRADICTION:
        raise InputError(
            f"measurements without noise contradict one another or the prior by {misfit:.2g} of their values; set"
            " estimator.noise_variance to the variance of their noise"
        )
