"""The minimum-variance estimate (Wood et al. 2005, Eq. 4): choice of a form and bound on its numerical error.

With g = H f + v, prior mean f0 and covariance P0, and noise covariance Rv,

    f^ = f0 + A (g - H f0),   A = P0 H^T (H P0 H^T + Rv)^-1.                      (Eq. 4)

Six forms compute it (`forms`). The cheapest one suited to the shape and the noise runs first; if the bound on its
error or on its variances exceeds the tolerance, the next more robust one runs. If none succeeds, InputError is raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import free_memory

from ..forms.cholesky import covariance, information
from ..forms.dual import dual
from ..forms.form import Form, NotSolvableError
from ..forms.square_root import square_root_covariance, square_root_information
from ..forms.svd import svd
from ..output.run_json import RejectedForm, SolverReport
from ..problem import Problem
from .certificate import RefinedForm, RefinedSolution, estimate_rounding, refine, variance_error, variance_rounding
from .residuals import DoubleDouble, ExactResiduals

TOLERANCE = 1e-8
LEAST_DIGITS = 1.0  # digits that the condition number must leave to a form that squares the matrix
EPS = float(np.finfo(np.float64).eps)
CONTRADICTION = 1e-6  # relative misfit of noise-free measurements; the precision of float32 files
USEFUL_BOUND = 1e-3  # bound below which an estimate shows whether noise-free measurements are met
UNKNOWN_BOUND = 10.0  # bound above which u is unknown, and with it which measurements contradict
WIDE_NOISE = 1e12  # ratio of the largest to the least noise variance from which the SVD loses the noisy rows
FORMS: dict[str, Callable[[Problem], Form]] = {
    "covariance": covariance,
    "information": information,
    "square-root-information": square_root_information,
    "square-root-covariance": square_root_covariance,
    "svd": svd,
    "dual": dual,
}


def needed_memory(form: str, measurements: int, unknowns: int, *, correlated: bool = False) -> int:
    """Return the bytes needed by a form and its error analysis; a `correlated` prior adds its root and copies of it."""
    both = measurements + unknowns
    matrix = {
        "covariance": 3 * measurements**2 + 2 * measurements * unknowns + 2 * unknowns**2,
        "information": 7 * unknowns**2,
        "square-root-information": 4 * both * unknowns + 2 * unknowns**2,
        "square-root-covariance": 3 * both**2,
        "svd": 4 * measurements * unknowns + 5 * unknowns**2,
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


def factorise(problem: Problem, method: str = "auto", tolerance: float = TOLERANCE) -> tuple[Form, SolverReport]:
    """Return the form whose posterior variances are accurate to `tolerance`. Raises InputError if there is none."""
    form, solver, _ = _first_accepted(ExactResiduals(problem), method, tolerance, None)
    return form, solver


def estimate(
    problem: Problem,
    recorded: FloatArray,
    method: str = "auto",
    tolerance: float = TOLERANCE,
    before: Estimate | None = None,
) -> Estimate:
    """Reconstruct the image with the least mean squared error of any linear estimator (Eq. 4).

    recorded : (M,) g, in the units of f
    before : an estimate from other measurements with the same H, prior and noise, whose form is tried first
    Raises InputError for values that are not finite, if memory does not suffice, or if no form reaches `tolerance`.
    """
    if recorded.shape != (problem.measurements,) or not np.isfinite(recorded).all():
        raise InputError(
            f"expected {problem.measurements} finite measurements, got others; leave dead pixels out first"
        )
    residuals = ExactResiduals(problem) if before is None else before.residuals
    form, solver, refined = _by_form_of(before, tolerance, recorded) or _first_accepted(
        residuals, method, tolerance, recorded
    )
    if refined is None:
        raise RuntimeError("measurements were given, but no estimate was computed")
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
) -> tuple[Form, SolverReport, RefinedSolution | None] | None:
    """Return the estimate by the form of another one, None where that form does not reach the tolerance by itself."""
    if before is None or before.solver.method not in FORMS:
        return None
    solver, refined = _with_estimate(before.solver, before.form, before.residuals, recorded)
    return (before.form, solver, refined) if _accepted(solver, tolerance, []) else None


def _candidates(problem: Problem, method: str) -> tuple[list[str], str]:
    """Names of the forms to try, the cheapest first, and the reason for them."""
    if method != "auto":
        return [method], "requested by estimator.method"
    if not problem.noisy:
        return ["dual"], "some measurements have no noise"
    noise, fewer = problem.noise_variance, problem.measurements < problem.prior.dimension
    # If the information form fails, H has a null space, which the covariance form tolerates.
    first = ["covariance"] if fewer else ["information", "covariance"]
    why = "fewer measurements than unknowns" if fewer else "no fewer measurements than unknowns"
    if noise.size and noise.max() > WIDE_NOISE * noise.min():
        ratio = f"noise variances {noise.max() / noise.min():.0e} apart"
        return [*first, "square-root-information", "dual"], f"{why}, {ratio}"
    array_form = ["square-root-covariance"] if fewer else []
    return [*first, "svd", *array_form, "square-root-information", "dual"], why


def _first_accepted(
    residuals: ExactResiduals, method: str, tolerance: float, recorded: FloatArray | None
) -> tuple[Form, SolverReport, RefinedSolution | None]:
    problem = residuals.problem
    names, why = _candidates(problem, method)
    tried: list[RejectedForm] = []
    refinable: list[Form] = []  # forms whose estimate is accurate and whose variances are not
    solver: SolverReport | None = None
    refined: RefinedSolution | None = None
    for name in names:
        try:
            form = _factorised(name, problem)
            error, rounding = variance_error(form, residuals), variance_rounding(form)
            solver = _solver(name, why, form.condition, error + rounding, tried)
            _check_rounding(error, rounding, tolerance)
            solver, refined = _with_estimate(solver, form, residuals, recorded)
        except (NotSolvableError, np.linalg.LinAlgError) as failure:
            tried.append(RejectedForm(method=name, why_not=str(failure)))
            continue
        if _accepted(solver, tolerance, tried):
            return form, solver, refined
        if solver.bound is None or solver.bound <= tolerance:
            refinable.append(form)
    for form in _last_resorts(residuals, refinable) if method == "auto" else []:
        error = form.variance_error + variance_rounding(form)
        solver = _solver(form.description, why, form.condition, error, tried)
        solver, refined = _with_estimate(solver, form.form, residuals, recorded)
        if _accepted(solver, tolerance, tried):
            return form, solver, refined
    known = solver is not None and solver.bound is not None and solver.bound < UNKNOWN_BOUND
    if refined is not None and recorded is not None and known:
        _check_contradictions(residuals, recorded, refined)
    raise InputError(
        f"no form of the estimator reaches a relative error of {tolerance:g} here ("
        + "; ".join(f"{form.method}: {form.why_not}" for form in tried)
        + "); raise estimator.noise_variance or estimator.tolerance"
    )


def _solver(method: str, why: str, condition: float, variance_bound: float, tried: list[RejectedForm]) -> SolverReport:
    return SolverReport(
        way="",
        method=method,
        why=why,
        condition=condition if isfinite(condition) else None,
        bound=None,
        unit="standard deviation of the prior",
        variance_bound=variance_bound,
        refinements=0,
        tried=tuple(tried),
    )


def _check_rounding(error: float, rounding: float, tolerance: float) -> None:
    """Raise InputError if the rounding of P0 alone exceeds the tolerance; `error` is that of the form."""
    if error <= tolerance < rounding:
        raise InputError(
            f"the prior's covariance is so nearly singular that its rounding changes variances by {rounding:.1e},"
            f" relative, where {tolerance:g} is allowed; shorten prior.correlation_length, or raise estimator.tolerance"
        )


def _last_resorts(residuals: ExactResiduals, refinable: list[Form]) -> list[RefinedForm]:
    """Return forms whose every solution is refined, most robust first; none where a measurement has no noise.

    A bound on the estimate from nearly equal rows without noise is itself an estimate, which refinement can mislead.
    """
    if not residuals.problem.noisy:
        return []
    return [RefinedForm(form.problem, form.condition, form, residuals) for form in reversed(refinable)]


def _with_estimate(
    solver: SolverReport,
    form: Form,
    residuals: ExactResiduals,
    recorded: FloatArray | None,
) -> tuple[SolverReport, RefinedSolution | None]:
    if recorded is None:
        return solver, None
    with np.errstate(all="ignore"):
        deviation = residuals.recorded(recorded)
    refined = refine(form, residuals, np.zeros((form.problem.prior.dimension, 1)), deviation)
    bound = float(refined.bound[0]) + EPS
    bound += estimate_rounding(form, refined.coefficients[:, 0], refined.multipliers[:, 0])
    if bound <= USEFUL_BOUND:
        _check_contradictions(residuals, recorded, refined)
    return solver.model_copy(update={"bound": bound, "refinements": refined.steps}), refined


def _accepted(solver: SolverReport, tolerance: float, tried: list[RejectedForm]) -> bool:
    """Return True if both bounds meet the tolerance, which NaN does not; else note the reason."""
    met = solver.variance_bound <= tolerance and (solver.bound is None or solver.bound <= tolerance)
    if not met:
        bad = not solver.variance_bound <= tolerance
        quantity, worst = ("variances are", solver.variance_bound) if bad else ("the estimate is", solver.bound)
        tried.append(RejectedForm(method=solver.method, why_not=f"{quantity} accurate to {worst:.1e} only"))
    return met


def _check_contradictions(residuals: ExactResiduals, recorded: FloatArray, refined: RefinedSolution) -> None:
    with np.errstate(all="ignore"):
        misfit = residuals.contradiction(recorded, DoubleDouble(refined.coefficients, refined.low))
    if misfit > CONTRADICTION:
        raise InputError(
            f"measurements without noise contradict one another or the prior by {misfit:.2g} of their values; set"
            " estimator.noise_variance to the variance of their noise"
        )


def _factorised(name: str, problem: Problem) -> Form:
    correlated = not problem.prior.independent
    needed, free = needed_memory(name, problem.measurements, problem.unknowns, correlated=correlated), free_memory()
    if needed > free:
        raise NotSolvableError(f"it needs {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free")
    with np.errstate(all="ignore"):  # the certificate detects overflow
        form = FORMS[name](problem)
    if name in ("covariance", "information") and form.condition * EPS > 10**-LEAST_DIGITS:
        raise NotSolvableError(f"a condition number of {form.condition:.1e} leaves no digits")
    return form
