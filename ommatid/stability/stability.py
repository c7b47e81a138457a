"""Correct digits of the certified solver on stiff and extreme cases, against the exact answer.

An answer is right if the estimate and every posterior variance have nine digits. Otherwise it has to be refused or
state a large enough error bound; an answer with an error beyond its bound is a silent loss.

The figure shows the digits lost against the noise variance, with and without a null space of H: by the estimate before
and after refinement, and by the worst posterior variance, with the bounds that are stated. A third panel compares the
errors of all cases with their bounds: points above the dotted line, at ten times the bound, would be silent losses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import log10
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.curves import Style, draw_curve, draw_level, label
from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.reconstruct.estimator.certificate import NEGLIGIBLE_VARIANCE
from ommatid.reconstruct.estimator.estimate import TOLERANCE, Estimate, estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.runtime.errors import InputError
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.study import Row, write_rows

from .cases import Matrices, StabilityCase, extreme_cases, noise_sweep
from .exact_answer import ExactAnswer, exact_answer, relative_error, worst_relative_error

FLOAT64_DIGITS = 16.0
QUANTITIES: tuple[tuple[str, str, Style], ...] = (
    ("alone", "estimate before refinement", {"color": "tab:orange", "marker": "v", "markersize": 5}),
    ("refined", "estimate", {"color": "black", "marker": "x", "markersize": 5, "linewidth": 2.0}),
    ("variance", "worst posterior variance", {"color": "tab:blue", "marker": "o", "markersize": 5}),
)
BOUNDS: tuple[tuple[str, str, Style], ...] = (
    ("bound", "bound of the estimate", {"color": "black", "linestyle": "--", "linewidth": 1}),
    ("variance_bound", "bound of the variances", {"color": "tab:blue", "linestyle": "--", "linewidth": 1}),
)
TITLES = {"three": "three types: H has full rank", "two": "two types: H has a null space"}
LEAST_SHOWN = 1e-17  # errors and bounds below are drawn there
DIGITS = 9.0  # of the estimate and of every posterior variance
ALLOWED_EXCESS = 10.0  # ratio of an error to its bound: variances are checked on a sample of pixels
NO_STATEMENT = 0.1  # a bound above it states nothing
RIGHT, REFUSED, FEWER, SILENT = "right", "refused", "fewer digits, as stated", "SILENT LOSS"


@dataclass(frozen=True)
class StabilityOutcome:
    """Result of one case.

    form : that ran
    alone, refined, variance : correct digits of u from the form alone, of the refined u, of the worst variance
    bound, variance_bound : relative error bounds stated by the estimator;  reason : why the case was refused
    """

    case: str
    measurements: int
    unknowns: int
    form: str
    verdict: str
    alone: float | None = None
    refined: float | None = None
    variance: float | None = None
    bound: float | None = None
    variance_bound: float | None = None
    reason: str = ""


Results = list[tuple[StabilityCase, StabilityOutcome]]


@own_style()
def write_figure(path: Path, results: Results, files: FigureFiles = SCREEN_PNG) -> None:
    """Draw the digits lost against the noise, one panel per H, and the errors of all cases against their bounds."""
    figure = new_figure(14, 5.5, layout="constrained")
    axes = figure.subplots(1, len(TITLES) + 1)
    for panel, (lenses, title) in zip(axes, TITLES.items(), strict=False):
        label(panel, title, "noise variance (grey levels squared)", "decimal digits lost, of 16", "x")
        _draw_sweep(panel, [(case.noise_variance[0], outcome) for case, outcome in results if case.curve == lenses])
    _draw_bounds(axes[-1], [outcome for _, outcome in results])
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle("Digits lost by the certified solver, against exact arithmetic")
    files.replace(figure, path)


def _draw_sweep(panel: Any, points: list[tuple[float, StabilityOutcome]]) -> None:
    """Draw the digits lost against the noise variance, the bounds as dashed lines; the form that ran stands below."""
    rows: list[Row] = []
    for noise, outcome in points:
        panel.text(noise, -0.4, outcome.form or REFUSED, rotation=90, ha="center", va="top", fontsize=7, color="0.4")
        if outcome.refined is not None:
            left = {field: getattr(outcome, field) for field, *_ in QUANTITIES}
            left |= {field: digits(getattr(outcome, field)) for field, *_ in BOUNDS}
            rows.append({"noise": noise, **{field: FLOAT64_DIGITS - each for field, each in left.items()}})
    for field, name, style in (*QUANTITIES, *BOUNDS):
        draw_curve(panel, rows, "noise", field, label=name, **style)
    panel.set_ylim(-3.8, 12)
    panel.set_yticks(range(0, 13, 2))
    draw_level(panel, FLOAT64_DIGITS - DIGITS, "nine digits left")


def _draw_bounds(panel: Any, outcomes: list[StabilityOutcome]) -> None:
    """Draw the error of every answer against the bound that it states."""
    solved = [outcome for outcome in outcomes if outcome.refined is not None]
    title = f"{len(solved)} cases solved, {len(outcomes) - len(solved)} refused"
    label(panel, title, "stated relative bound", "relative error, at least 1e-16", "xy")
    for (field, name, style), (bound, *_) in zip(QUANTITIES[1:], BOUNDS, strict=True):
        stated = [max(getattr(outcome, bound), LEAST_SHOWN) for outcome in solved]
        errors = [10 ** -getattr(outcome, field) for outcome in solved]
        panel.plot(stated, errors, label=name, **style | {"linestyle": "none", "markersize": 4})
    ends = np.array([LEAST_SHOWN, 1.0])
    panel.plot(ends, ALLOWED_EXCESS * ends, color="0.5", linewidth=1, linestyle=":")
    panel.set(xlim=(LEAST_SHOWN, 1e-6), ylim=(LEAST_SHOWN, 1e-6))


def assess(case: StabilityCase, exact: ExactAnswer | None) -> StabilityOutcome:
    """Solve a case. `exact` is None for cases that have to be refused."""
    sizes = case.matrix.shape
    try:
        solution = estimate(case.problem, case.recorded, TOLERANCE)
    except InputError as error:
        return StabilityOutcome(case.name, *sizes, "", REFUSED, reason=str(error))
    if exact is None:
        form = solution.solver.method
        return StabilityOutcome(case.name, *sizes, form, SILENT, reason="should have been refused")
    return _compare(case, solution, exact)


def _compare(case: StabilityCase, solution: Estimate, exact: ExactAnswer) -> StabilityOutcome:
    problem, solver = solution.form.problem, solution.solver
    residual = ExactResiduals(problem).recorded(case.recorded).high
    with np.errstate(all="ignore"):
        alone, _ = solution.form.solve(np.zeros((problem.prior.dimension, 1)), residual)
        variance = solution.form.variance()
    alone_error, refined_error = (relative_error(u, exact.coefficients) for u in (alone[:, 0], solution.coefficients))
    negligible = NEGLIGIBLE_VARIANCE * problem.prior.variance
    variance_error = worst_relative_error(variance, exact.variance, negligible)
    bounds = (np.inf if solver.bound is None else solver.bound, solver.variance_bound)
    lost = any(
        error > max(ALLOWED_EXCESS * bound, 10**-DIGITS) and bound < NO_STATEMENT
        for error, bound in zip((refined_error, variance_error), bounds, strict=True)
    )
    enough = min(digits(refined_error), digits(variance_error)) >= DIGITS
    return StabilityOutcome(
        case.name,
        problem.measurements,
        problem.unknowns,
        solver.method,
        SILENT if lost or not np.isfinite(solution.image).all() else RIGHT if enough else FEWER,
        digits(alone_error),
        digits(refined_error),
        digits(variance_error),
        *bounds,
    )


def digits(error: float) -> float:
    """Return the correct decimal digits of a relative error, between 0 and those of float64."""
    if not np.isfinite(error):
        return 0.0
    return FLOAT64_DIGITS if error <= 10**-FLOAT64_DIGITS else max(0.0, -log10(error))


def run(matrices: Matrices, progress: Callable[[float], None]) -> Results:
    """Solve the noise sweep and every other case."""
    cases, results = [*noise_sweep(matrices), *extreme_cases(matrices)], Results()
    for case in cases:
        exact = None if case.required == "refuse" else exact_answer(case.problem, case.recorded)
        results.append((case, assess(case, exact)))
        progress(len(results) / len(cases))
    return results


def write_stability(
    folder: Path, matrices: Matrices, progress: Callable[[float], None], figures: FigureFiles = SCREEN_PNG
) -> dict[str, Any]:
    """Write stability.csv and stability.png; return a summary. Raises InputError or MachineError."""
    with occupied(folder):
        results = run(matrices, progress)
        cases = [asdict(outcome) for _, outcome in results]
        write_rows(folder / "stability.csv", cases)
        write_figure(folder / "stability.png", results, figures)
    verdicts = [case["verdict"] for case in cases]
    return {
        "files": [str(folder / name) for name in ("stability.csv", "stability.png")],
        "verdicts": {verdict: verdicts.count(verdict) for verdict in (RIGHT, REFUSED, FEWER, SILENT)},
        "cases": cases,
    }


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the printed table: counts, the least digits of solved cases, and refused cases."""
    lines = [(verdict, f"{count} cases") for verdict, count in summary["verdicts"].items()]
    solved = [case for case in summary["cases"] if case["verdict"] != REFUSED]
    for field, name in (("refined", "least digits of an estimate"), ("variance", "least digits of a variance")):
        worst: dict[str, Any] = min(solved, key=lambda case: float(case[field]))
        lines.append((name, f"{worst[field]:.1f}: {worst['case']}, {worst['form']}"))
    refused = [case["case"] for case in summary["cases"] if case["verdict"] == REFUSED]
    if refused:
        lines.append(("refused, for the reason in stability.csv", "; ".join(refused)))
    return [*lines, ("files", ", ".join(summary["files"]))]
