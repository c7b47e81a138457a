"""How many digits every form of the estimator has on stiff and extreme cases, against the exact answer.

An answer is right if the estimate and every posterior variance have nine digits; else it must be refused, or its own
bound must say so. What claims more than it has is a silent loss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, astuple, fields
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.estimator.certificate import NOTHING
from ommatid.reconstruct.estimator.estimate import FORMS, TOLERANCE, Estimate, estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import make_folder, write_csv, write_text

from .cases import Matrices, StabilityCase, cases, sweep
from .exact_answer import ExactAnswer, exact_answer
from .figure import write_figure
from .outcome import StabilityOutcome, SweepOutcome

Vector = NDArray[np.float64]

AUTO = "auto"
DIGITS = 9.0  # of the estimate and of every posterior variance
MOST = 16.0  # that float64 holds
FORGIVEN = 10.0  # times its bound that an error may be: variances are checked on a sample of pixels
SOMETHING = 0.1  # a bound above it promises nothing
ANY = 1e300  # tolerance: every answer is wanted, with its bound
RIGHT, REFUSED, FEWER, SILENT = "right", "refused", "fewer digits, and says so", "SILENT LOSS"


def assess(case: StabilityCase, asked: str, exact: ExactAnswer | None) -> StabilityOutcome:
    """Let one form, or `auto`, solve a case. `exact` may be None for what is to be refused."""
    sizes = case.matrix.shape
    try:
        found = estimate(case.problem, case.recorded, asked, TOLERANCE if asked == AUTO else ANY)
    except InputError as error:
        return StabilityOutcome(case.name, *sizes, asked, "", REFUSED, reason=str(error))
    if exact is None:
        return StabilityOutcome(
            case.name, *sizes, asked, found.solver.method, SILENT, reason="should have been refused"
        )
    return _compared(case, asked, found, exact)


def _compared(case: StabilityCase, asked: str, found: Estimate, exact: ExactAnswer) -> StabilityOutcome:
    problem, solver = found.form.problem, found.solver
    residual = ExactResiduals(problem).recorded(case.recorded).high
    with np.errstate(all="ignore"):
        alone, _ = found.form.solve(np.zeros((problem.prior.freedoms, 1)), residual)
        variance = found.form.variance()
    size = float(np.linalg.norm(exact.freedoms.high))
    errors = [_share(float(np.linalg.norm(exact.freedoms.away(u))), size) for u in (alone[:, 0], found.freedoms)]
    right = exact.variance.high
    wrong = np.abs(exact.variance.away(variance))
    wrong[(right == 0) & (wrong <= NOTHING * problem.prior.variance)] = 0.0
    errors.append(float(np.divide(wrong, right, out=np.where(wrong > 0, np.inf, 0.0), where=right > 0).max(initial=0)))
    bound = ANY if solver.bound is None else solver.bound
    promised = (bound, solver.variance_bound)
    lost = any(
        error > max(FORGIVEN * promise, 10**-DIGITS) and promise < SOMETHING
        for error, promise in zip(errors[1:], promised, strict=True)
    )
    bad = not (np.isfinite(found.image).all() and np.isfinite(variance).all() and (variance >= 0).all())
    enough = min(digits(error) for error in errors[1:]) >= DIGITS
    verdict = SILENT if lost or (bad and max(promised) < SOMETHING) else RIGHT if enough else FEWER
    alone_digits, refined_digits, variance_digits = (digits(error) for error in errors)
    return StabilityOutcome(
        case.name,
        problem.measurements,
        problem.unknowns,
        asked,
        solver.method,
        verdict,
        alone_digits,
        refined_digits,
        variance_digits,
        *promised,
    )


def digits(error: float) -> float:
    """Right decimal digits of a relative error, between 0 and what float64 holds."""
    if not np.isfinite(error):
        return 0.0
    return MOST if error <= 10**-MOST else max(0.0, -log10(error))


def _share(error: float, size: float) -> float:
    return error / size if size > 0 else (0.0 if error == 0 else float("inf"))


def run(matrices: Matrices, progress: Callable[[float], None]) -> tuple[list[SweepOutcome], list[StabilityOutcome]]:
    """The sweep over noise with every form and `auto`, and every other case with `auto`."""
    swept, others = list(sweep(matrices)), list(cases(matrices))
    total, done = len(swept) + len(others), 0
    curves: list[SweepOutcome] = []
    for lenses, noise, case in swept:
        exact = _exact(case)
        curves += [SweepOutcome(lenses, noise, assess(case, asked, exact)) for asked in (AUTO, *FORMS)]
        done += 1
        progress(done / total)
    table: list[StabilityOutcome] = []
    for case in others:
        table.append(assess(case, AUTO, None if case.kind == "hopeless" else _exact(case)))
        done += 1
        progress(done / total)
    return curves, table


def _exact(case: StabilityCase) -> ExactAnswer:
    return exact_answer(case.problem, case.recorded)


def write_stability(folder: Path, matrices: Matrices, progress: Callable[[float], None]) -> dict[str, Any]:
    """Write stability.csv, stability.md and stability.png; a summary. Raises InputError or DeniedError."""
    make_folder(folder)
    curves, table = run(matrices, progress)
    outcomes = [one.outcome for one in curves] + table
    automatic = [one for one in outcomes if one.asked == AUTO]
    columns = [field.name for field in fields(StabilityOutcome)]
    write_csv(folder / "stability.csv", columns, (astuple(outcome) for outcome in outcomes))
    write_text(folder / "stability.md", markdown(automatic))
    write_figure(folder / "stability.png", curves)
    counts = {verdict: sum(one.verdict == verdict for one in automatic) for verdict in (RIGHT, REFUSED, FEWER, SILENT)}
    return {
        "files": [str(folder / name) for name in ("stability.csv", "stability.md", "stability.png")],
        "auto": counts,
        "silent_losses_of_any_form": sum(one.verdict == SILENT for one in outcomes),
        "cases": [asdict(one) for one in automatic],
    }


def rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of the printed table: counts, the worst of what is right, and what was refused."""
    lines = [(verdict, f"{count} cases") for verdict, count in summary["auto"].items()]
    solved = [case for case in summary["cases"] if case["verdict"] != REFUSED]
    for field, name in (("refined", "least digits of an estimate"), ("variance", "least digits of a variance")):
        worst: dict[str, Any] = min(solved, key=lambda case: float(case[field]))
        lines.append((name, f"{worst[field]:.1f}: {worst['case']}, {worst['ran']}"))
    refused = [case["case"] for case in summary["cases"] if case["verdict"] == REFUSED]
    if refused:
        lines.append(("refused, with the sentence in stability.md", "; ".join(refused)))
    return [*lines, ("files", ", ".join(summary["files"]))]


def markdown(outcomes: Iterable[StabilityOutcome]) -> str:
    """A table of cases, the form that ran, and its right digits."""
    lines = [
        '# Stiff and extreme cases, `method = "auto"`',
        "",
        "Right digits against the exact answer; 16 is all that float64 holds. Bounds are relative.",
        "",
        "| case | measurements x unknowns | form | digits of the estimate | of the worst variance | bound | verdict |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in outcomes:
        size = f"{one.measurements} x {one.unknowns}"
        if one.refined is None or one.variance is None or one.bound is None:
            lines.append(f"| {one.case} | {size} | | | | | refused: {one.reason} |")
        else:
            found = f"{one.ran} | {one.refined:.1f} | {one.variance:.1f} | {one.bound:.0e}"
            lines.append(f"| {one.case} | {size} | {found} | {one.verdict} |")
    return "\n".join(lines) + "\n"
