"""Correct digits of every form of the estimator on stiff and extreme cases, against the exact answer.

An answer is right if the estimate and every posterior variance have nine digits. Otherwise it has to be refused or
state a large enough error bound; an answer with an error beyond its bound is a silent loss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, astuple, fields
from math import log10
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.reconstruct.estimator.certificate import NEGLIGIBLE_VARIANCE
from ommatid.reconstruct.estimator.estimate import FORMS, TOLERANCE, Estimate, estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_csv, write_text
from ommatid.runtime.outputs.occupied import occupied

from .cases import Matrices, StabilityCase, extreme_cases, noise_sweep
from .exact_answer import ExactAnswer, exact_answer
from .figure import write_figure
from .outcome import StabilityOutcome, SweepOutcome

AUTO = "auto"
DIGITS = 9.0  # of the estimate and of every posterior variance
FLOAT64_DIGITS = 16.0
ALLOWED_EXCESS = 10.0  # ratio of an error to its bound: variances are checked on a sample of pixels
NO_STATEMENT = 0.1  # a bound above it states nothing
ANY_TOLERANCE = 1e300  # accepts every answer, with its bound
RIGHT, REFUSED, FEWER, SILENT = "right", "refused", "fewer digits, as stated", "SILENT LOSS"


def assess(case: StabilityCase, method: str, exact: ExactAnswer | None) -> StabilityOutcome:
    """Solve a case with one form or `auto`. `exact` is None for cases that have to be refused."""
    sizes = case.matrix.shape
    try:
        solution = estimate(case.problem, case.recorded, method, TOLERANCE if method == AUTO else ANY_TOLERANCE)
    except InputError as error:
        return StabilityOutcome(case.name, *sizes, method, "", REFUSED, reason=str(error))
    if exact is None:
        ran = solution.solver.method
        return StabilityOutcome(case.name, *sizes, method, ran, SILENT, reason="should have been refused")
    return _compare(case, method, solution, exact)


def _compare(case: StabilityCase, method: str, solution: Estimate, exact: ExactAnswer) -> StabilityOutcome:
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
    bounds = (ANY_TOLERANCE if solver.bound is None else solver.bound, solver.variance_bound)
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
        method,
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


def run(matrices: Matrices, progress: Callable[[float], None]) -> tuple[list[SweepOutcome], list[StabilityOutcome]]:
    """Run the noise sweep with every form and `auto`, and every other case with `auto`."""
    sweep, others = list(noise_sweep(matrices)), list(extreme_cases(matrices))
    total = len(sweep) + len(others)
    curves: list[SweepOutcome] = []
    for done, (lenses, noise, case) in enumerate(sweep, start=1):
        exact = exact_answer(case.problem, case.recorded)
        curves += [SweepOutcome(lenses, noise, assess(case, method, exact)) for method in (AUTO, *FORMS)]
        progress(done / total)
    table: list[StabilityOutcome] = []
    for done, case in enumerate(others, start=len(sweep) + 1):
        exact = None if case.required == "refuse" else exact_answer(case.problem, case.recorded)
        table.append(assess(case, AUTO, exact))
        progress(done / total)
    return curves, table


def write_stability(
    folder: Path, matrices: Matrices, progress: Callable[[float], None], figures: FigureFiles = SCREEN_PNG
) -> dict[str, Any]:
    """Write stability.csv, stability.md and stability.png; return a summary. Raises InputError or MachineError."""
    with occupied(folder):
        return _write(folder, *run(matrices, progress), figures)


def _write(
    folder: Path, curves: list[SweepOutcome], table: list[StabilityOutcome], figures: FigureFiles
) -> dict[str, Any]:
    outcomes = [point.outcome for point in curves] + table
    automatic = [outcome for outcome in outcomes if outcome.asked == AUTO]
    verdicts = [outcome.verdict for outcome in automatic]
    columns = [field.name for field in fields(StabilityOutcome)]
    write_csv(folder / "stability.csv", columns, (astuple(outcome) for outcome in outcomes))
    write_text(folder / "stability.md", markdown(automatic))
    write_figure(folder / "stability.png", curves, figures)
    return {
        "files": [str(folder / name) for name in ("stability.csv", "stability.md", "stability.png")],
        "auto": {verdict: verdicts.count(verdict) for verdict in (RIGHT, REFUSED, FEWER, SILENT)},
        "silent_losses_of_any_form": sum(outcome.verdict == SILENT for outcome in outcomes),
        "cases": [asdict(outcome) for outcome in automatic],
    }


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the printed table: counts, the least digits of solved cases, and refused cases."""
    lines = [(verdict, f"{count} cases") for verdict, count in summary["auto"].items()]
    solved = [case for case in summary["cases"] if case["verdict"] != REFUSED]
    for field, name in (("refined", "least digits of an estimate"), ("variance", "least digits of a variance")):
        worst: dict[str, Any] = min(solved, key=lambda case: float(case[field]))
        lines.append((name, f"{worst[field]:.1f}: {worst['case']}, {worst['ran']}"))
    refused = [case["case"] for case in summary["cases"] if case["verdict"] == REFUSED]
    if refused:
        lines.append(("refused, for the reason in stability.md", "; ".join(refused)))
    return [*lines, ("files", ", ".join(summary["files"]))]


def markdown(outcomes: Iterable[StabilityOutcome]) -> str:
    """Return a table of cases with the form that ran and its correct digits."""
    lines = [
        '# Stiff and extreme cases, `method = "auto"`',
        "",
        "Correct digits against the exact answer, of 16 in float64. Bounds are relative.",
        "",
        "| case | measurements x unknowns | form | digits of the estimate | of the worst variance | bound | verdict |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for outcome in outcomes:
        start = f"| {outcome.case} | {outcome.measurements} x {outcome.unknowns}"
        if outcome.refined is None or outcome.variance is None or outcome.bound is None:
            lines.append(f"{start} | | | | | refused: {outcome.reason} |")
        else:
            figures = f"{outcome.refined:.1f} | {outcome.variance:.1f} | {outcome.bound:.0e}"
            lines.append(f"{start} | {outcome.ran} | {figures} | {outcome.verdict} |")
    return "\n".join(lines) + "\n"
