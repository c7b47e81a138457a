"""Correct digits of the certified solver on stiff and extreme cases, against the exact answer.

An answer is right if the estimate and every posterior variance have nine digits. Otherwise it has to be refused or
state a large enough error bound; an answer with an error beyond its bound is a silent loss.

The figure shows the digits lost against the noise variance, with and without a null space of H: by the estimate before
and after refinement, and by the worst posterior variance, with the bounds that are stated. A third panel compares the
errors of all cases with their bounds: points above the dotted line, at ten times the bound, would be silent losses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, fields
from math import log10
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.reconstruct.estimator.certificate import NEGLIGIBLE_VARIANCE
from ommatid.reconstruct.estimator.estimate import TOLERANCE, Estimate, estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_csv
from ommatid.runtime.outputs.occupied import occupied

from .cases import Matrices, StabilityCase, extreme_cases, noise_sweep
from .exact_answer import ExactAnswer, exact_answer

FLOAT64_DIGITS = 16.0
QUANTITIES = (
    ("alone", "estimate before refinement", {"color": "tab:orange", "marker": "v"}),
    ("refined", "estimate", {"color": "black", "marker": "x", "linewidth": 2.0}),
    ("variance", "worst posterior variance", {"color": "tab:blue", "marker": "o"}),
)
BOUNDS = (
    ("bound", "bound of the estimate", {"color": "black"}),
    ("variance_bound", "bound of the variances", {"color": "tab:blue"}),
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
        _draw_sweep(panel, [(case.noise_variance[0], outcome) for case, outcome in results if case.curve == lenses])
        panel.set_title(title, fontsize=10)
    _draw_bounds(axes[-1], [outcome for _, outcome in results])
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle("Digits lost by the certified solver, against exact arithmetic")
    files.replace(figure, path)


def _draw_sweep(panel: Any, points: list[tuple[float, StabilityOutcome]]) -> None:
    """Draw the digits lost against the noise variance, the bounds as dashed lines; the form that ran stands below."""
    solved = [(noise, outcome) for noise, outcome in points if outcome.refined is not None]
    noises = [noise for noise, _ in solved]
    for field, label, style in QUANTITIES:
        lost = [FLOAT64_DIGITS - getattr(outcome, field) for _, outcome in solved]
        panel.plot(noises, lost, label=label, markersize=5, **style)
    for field, label, style in BOUNDS:
        stated = [FLOAT64_DIGITS - digits(getattr(outcome, field)) for _, outcome in solved]
        panel.plot(noises, stated, label=label, linestyle="--", linewidth=1, **style)
    for noise, outcome in points:
        words = outcome.form or REFUSED
        panel.text(noise, -0.4, words, rotation=90, ha="center", va="top", fontsize=7, color="0.4")
    panel.set_xscale("log")
    panel.set_ylim(-3.8, 12)
    panel.set_yticks(range(0, 13, 2))
    panel.grid(visible=True, color="0.9")
    panel.axhline(FLOAT64_DIGITS - DIGITS, color="0.5", linewidth=1, linestyle=":")
    panel.text(1e-30, FLOAT64_DIGITS - DIGITS + 0.1, "nine digits left", fontsize=8, color="0.4", va="bottom")
    panel.set_xlabel("noise variance (grey levels squared)")
    panel.set_ylabel("decimal digits lost, of 16")


def _draw_bounds(panel: Any, outcomes: list[StabilityOutcome]) -> None:
    """Draw the error of every answer against the bound that it states."""
    solved = [outcome for outcome in outcomes if outcome.refined is not None]
    for (field, label, style), (bound, *_) in zip(QUANTITIES[1:], BOUNDS, strict=True):
        stated = [max(getattr(outcome, bound), LEAST_SHOWN) for outcome in solved]
        errors = [10 ** -getattr(outcome, field) for outcome in solved]
        marks = {"color": style["color"], "marker": style["marker"], "linestyle": "none", "markersize": 4}
        panel.plot(stated, errors, label=label, **marks)
    ends = np.array([LEAST_SHOWN, 1.0])
    panel.plot(ends, ALLOWED_EXCESS * ends, color="0.5", linewidth=1, linestyle=":")
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlim(LEAST_SHOWN, 1e-6)
    panel.set_ylim(LEAST_SHOWN, 1e-6)
    panel.grid(visible=True, color="0.9")
    panel.set_title(f"{len(solved)} cases solved, {len(outcomes) - len(solved)} refused", fontsize=10)
    panel.set_xlabel("stated relative bound")
    panel.set_ylabel("relative error, at least 1e-16")


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
    size = float(np.linalg.norm(exact.coefficients.high))
    alone_error, refined_error = (
        _relative(float(np.linalg.norm(exact.coefficients.difference(u))), size)
        for u in (alone[:, 0], solution.coefficients)
    )
    right = exact.variance.high
    wrong = np.abs(exact.variance.difference(variance))
    wrong[(right == 0) & (wrong <= NEGLIGIBLE_VARIANCE * problem.prior.variance)] = 0.0
    relative = np.divide(wrong, right, out=np.where(wrong > 0, np.inf, 0.0), where=right > 0)
    variance_error = float(relative.max(initial=0))
    bounds = (np.inf if solver.bound is None else solver.bound, solver.variance_bound)
    lost = any(
        error > max(ALLOWED_EXCESS * bound, 10**-DIGITS) and bound < NO_STATEMENT
        for error, bound in zip((refined_error, variance_error), bounds, strict=True)
    )
    invalid = not (np.isfinite(solution.image).all() and np.isfinite(variance).all() and (variance >= 0).all())
    enough = min(digits(refined_error), digits(variance_error)) >= DIGITS
    return StabilityOutcome(
        case.name,
        problem.measurements,
        problem.unknowns,
        solver.method,
        SILENT if lost or (invalid and max(bounds) < NO_STATEMENT) else RIGHT if enough else FEWER,
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


def _relative(error: float, size: float) -> float:
    return error / size if size > 0 else (0.0 if error == 0 else float("inf"))


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
        outcomes = [outcome for _, outcome in results]
        columns = [field.name for field in fields(StabilityOutcome)]
        write_csv(folder / "stability.csv", columns, (astuple(outcome) for outcome in outcomes))
        write_figure(folder / "stability.png", results, figures)
    verdicts = [outcome.verdict for outcome in outcomes]
    return {
        "files": [str(folder / name) for name in ("stability.csv", "stability.png")],
        "verdicts": {verdict: verdicts.count(verdict) for verdict in (RIGHT, REFUSED, FEWER, SILENT)},
        "cases": [asdict(outcome) for outcome in outcomes],
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
