"""What would reduce the error of a run, ranked by what it would bring, as far as its own numbers tell.

The parts of the predicted error (Eq. 5) are those of this run's estimator. A noise of `factor` times the variance
changes its part by that factor with the same estimator, and the one that is optimal for the smaller noise is better:
the error stated is the largest to expect. More samples are the prediction of the run itself, and another lens type is
that of `another_type`.
"""

from __future__ import annotations

from dataclasses import dataclass

from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.output.verdict_words import (
    HALF_STEP,
    HALF_STEP_HOW,
    LEAST_GAIN,
    TIMES,
    follows_samples,
    is_trusted,
)

from .another_type import AnotherType


@dataclass(frozen=True)
class NextStep:
    """A change, how to make it, and the mean squared error with it.

    is_bound : True if the error is at most `mse`;  seconds : of the run with the change, None if not known
    """

    change: str
    how: str
    mse: float
    is_bound: bool = False
    seconds: float | None = None


# Cause, change, how to make it, and the factor on the cause's part of the error
CHANGES = (
    ("noise", "half the noise variance", "twice the light, or the mean of two frames", 0.5),
    ("quantisation", HALF_STEP, HALF_STEP_HOW, 0.25),
    ("misalignment", "positions of the lenses calibrated", "`ommatid calibrate`, then `estimator.misalignment`", 0.0),
)
SAMPLES = {"rendering": "`render.samples`", "calibration": "`calibration.samples`"}


def next_steps(report: RunReport, other: AnotherType | None = None) -> list[NextStep]:
    """Return the changes that reduce the error by a twentieth or more, the best first; none for a run without trust."""
    now, budget = report.error.predicted_mse, report.error.budget
    if not is_trusted(report) or now <= 0:
        return []
    steps = [_samples(report)] if report.spent.more and follows_samples(report) else []
    for name, change, how, factor in CHANGES:
        part = budget.get(name, 0.0)
        steps.append(NextStep(change, how, now - (1 - factor) * part, is_bound=True))
    if other is not None:
        how = f"{other.measurements} measurements more; `ommatid design` ranks others"
        words = f"another lens type, of magnification {other.magnification} on the pixel grid"
        steps.append(NextStep(words, how, _with_other_type(report, other)))
    useful = [step for step in steps if step is not None and step.mse <= (1 - LEAST_GAIN) * now]
    return sorted(useful, key=lambda step: step.mse)


def _with_other_type(report: RunReport, other: AnotherType) -> float:
    """Return the error with another type, which changes nothing of detail finer than f."""
    fixed = report.error.budget.get("detail", 0.0)
    return fixed + other.ratio * (report.error.predicted_mse - fixed)


def _samples(report: RunReport) -> NextStep | None:
    more = next((more for more in report.spent.more if more.times == TIMES), report.spent.more[-1])
    parts = {name: report.error.budget.get(name, 0.0) for name in SAMPLES}
    keys = " and ".join(key for name, key in SAMPLES.items() if parts[name])
    if not keys:
        return None
    return NextStep(f"{more.times} times the samples", keys, more.predicted_mse, seconds=more.seconds)
