"""Correct digits of every form of the estimator on stiff and extreme cases, against the exact answer.

An answer is right if the estimate and every posterior variance have nine digits. Otherwise it has to be refused or
state a large enough error bound; an answer with an error beyond its bound is a silent loss.

The figure shows the digits lost by every form against the noise variance, with three panels per H: the form alone,
refined, and the worst posterior variance. Refusals are marked above the curves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, astuple, dataclass, fields
from math import log10
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.reconstruct.estimator.certificate import NEGLIGIBLE_VARIANCE
from ommatid.reconstruct.estimator.estimate import FORMS, TOLERANCE, Estimate, estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_csv, write_text
from ommatid.runtime.outputs.occupied import occupied

from .cases import Matrices, StabilityCase, extreme_cases, noise_sweep
from .exact_answer import ExactAnswer, exact_answer

FLOAT64_DIGITS = 16.0
PANELS = (("alone", "estimate, the form alone"), ("refined", "estimate, refined"), ("variance", "worst variance"))
STYLES = {
    "covariance": ("tab:orange", "v"),
    "information": ("tab:red", "s"),
    "square-root-information": ("tab:purple", "D"),
    "square-root-covariance": ("tab:brown", "^"),
    "svd": ("tab:green", "o"),
    "dual": ("tab:blue", "P"),
    "auto": ("black", "x"),
}
FIRST_LANE, LANE_HEIGHT = FLOAT64_DIGITS + 1.5, 0.75  # of the marks of refusals, one lane per form
TITLES = {"three": "three types: H has full rank", "two": "two types: H has a null space"}
_TEXT = {"ha": "right", "fontsize": 8, "color": "0.4"}
AUTO = "auto"
DIGITS = 9.0  # of the estimate and of every posterior variance
ALLOWED_EXCESS = 10.0  # ratio of an error to its bound: variances are checked on a sample of pixels
NO_STATEMENT = 0.1  # a bound above it states nothing
ANY_TOLERANCE = 1e300  # accepts every answer, with its bound
RIGHT, REFUSED, FEWER, SILENT = "right", "refused", "fewer digits, as stated", "SILENT LOSS"


@dataclass(frozen=True)
class StabilityOutcome:
    """Result of one form for one case.

    alone, refined, variance : correct digits of u from the form alone, of the refined u, of the worst variance
    bound, variance_bound : relative error bounds stated by the estimator;  reason : why the case was refused
    """

    case: str
    measurements: int
    unknowns: int
    asked: str
    ran: str
    verdict: str
    alone: float | None = None
    refined: float | None = None
    variance: float | None = None
    bound: float | None = None
    variance_bound: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class SweepOutcome:
    """An outcome of the noise sweep: the name of H, the noise variance and the result."""

    lenses: str
    noise: float
    outcome: StabilityOutcome


@own_style()
def write_figure(path: Path, curves: list[SweepOutcome], files: FigureFiles = SCREEN_PNG) -> None:
    """Draw the digits lost, with one row of panels per H and one column per quantity."""
    figure = new_figure(14, 9.5, layout="constrained")
    axes = figure.subplots(len(TITLES), len(PANELS), sharex=True, sharey=True)
    for row, (lenses, title) in enumerate(TITLES.items()):
        for column, (field, quantity) in enumerate(PANELS):
            panel = axes[row][column]
            for lane, form in enumerate(STYLES):
                points = [point for point in curves if point.lenses == lenses and point.outcome.asked == form]
                _draw_form(panel, points, field, form, FIRST_LANE + lane * LANE_HEIGHT)
            _draw_axes(panel)
            panel.set_title(f"{title}\n{quantity}", fontsize=10)
            panel.set_xlabel("noise variance (grey levels squared)")
            panel.set_ylabel("decimal digits lost, of 16")
            panel.tick_params(labelleft=True, labelbottom=True)
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle("Digits lost by the forms of the estimator, against exact arithmetic")
    files.replace(figure, path)


def _draw_axes(panel: Any) -> None:
    top = FIRST_LANE + len(STYLES) * LANE_HEIGHT
    panel.set_xscale("log")
    panel.set_ylim(-0.5, top)
    panel.set_yticks(range(0, int(FLOAT64_DIGITS) + 1, 2))
    panel.grid(visible=True, color="0.9")
    panel.axhline(FLOAT64_DIGITS - 9, color="0.5", linewidth=1, linestyle=":")
    panel.axhspan(FIRST_LANE - LANE_HEIGHT, top, color="0.95", zorder=0)
    along = panel.get_yaxis_transform()
    panel.text(0.99, FLOAT64_DIGITS - 8.9, "nine digits left", **_TEXT, transform=along, va="bottom")
    panel.text(0.99, top - 0.3, "refused", **_TEXT, transform=along, va="top")


def _draw_form(panel: Any, points: list[SweepOutcome], field: str, form: str, lane: float) -> None:
    """Draw the digits lost by a form, and hollow marks in its lane where it refuses."""
    colour, marker = STYLES[form]
    values = [getattr(point.outcome, field) for point in points]
    lost = [float("nan") if value is None else FLOAT64_DIGITS - value for value in values]
    style = {"linewidth": 2.2, "markersize": 6, "zorder": 5} if form == "auto" else {"linewidth": 1.2, "markersize": 5}
    panel.plot([point.noise for point in points], lost, color=colour, marker=marker, label=form, **style)
    refused = [point.noise for point, value in zip(points, values, strict=True) if value is None]
    hollow = {"markerfacecolor": "none", "markersize": 5, "linestyle": "none"}
    panel.plot(refused, [lane] * len(refused), color=colour, marker=marker, **hollow)


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
