"""The verdict on a run in words, what would reduce its error, as far as its numbers tell, and the held-out check."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from ..verdict.verdict import SPURIOUS_SHARE
from .run_json import HeldOutEntry, HeldOutPrior, HeldOutReport, RunReport

TIMES = 4  # as many samples, in the sentence on more samples
LEAST_GAIN = 0.05  # relative fall of the error from which a change is worth a sentence
LEAST = 1e-300  # probability that is printed
MOST_ROWS = 5  # sub-imagers in the table, unless more are named


class Change(NamedTuple):
    """A change of the scene that reduces one cause's part of the error by a known factor, and how to make it."""

    words: str
    how: str
    factor: float


# The step of a [sensor] is 1 DN, that is 1 / gain electrons: bits alone raise the range, and the gain alone halves it.
HALF_STEP = "one more of `noise.bits`, or `sensor.gain` doubled with one more of `sensor.bits`"
CHANGES = {  # by the cause's name in the budget
    "noise": Change("half the noise variance", "twice the light, or the mean of two frames", 0.5),
    "quantisation": Change("half the quantisation step", HALF_STEP, 0.25),
    "frames": Change("twice the dark and flat frames", "`sensor.frames`", 0.5),
    "misalignment": Change(
        "positions of the lenses calibrated", "`ommatid calibrate`, then `estimator.misalignment`", 0.0
    ),
}
SAMPLES = {"rendering": "`render.samples`", "calibration": "`calibration.samples`"}


def follows_samples(report: RunReport) -> bool:
    """Return True if the parts of the error by the samples fall as their variances with more samples.

    They do not where the noise of H may have produced a notable share of the information: as it falls, so does what the
    measurements seem to tell, and the other parts grow.
    """
    return report.model.spurious_information <= SPURIOUS_SHARE


def heading(report: RunReport) -> str:
    """Return the verdict in two or three words."""
    if report.verdict.level != "green":
        return "not to be trusted" if report.verdict.level == "red" else "trusted with a doubt"
    return "trusted" if report.verdict.passed else "not checked"


def grounds(report: RunReport) -> str:
    """Return what the verdict rests on: the reasons against trust, or the checks that found nothing wrong."""
    verdict = report.verdict
    return "; ".join(
        verdict.reasons
        or (*verdict.doubts, *verdict.passed)
        or ("neither the residual nor the error could be checked",)
    )


class NextStep(NamedTuple):
    """A change, how to make it, and the mean squared error with it.

    causes : of the parts of the error that it reduces;  is_bound : True if the error is at most `mse`
    seconds : of the run with the change, None if not known
    """

    change: str
    how: str
    mse: float
    causes: tuple[str, ...] = ()
    is_bound: bool = False
    seconds: float | None = None


def steps_of(report: RunReport) -> list[NextStep]:
    """Return the changes that reduce parts of the error of a run, as far as its own numbers tell."""
    now, budget = report.error.predicted_mse, report.error.budget
    steps = [
        NextStep(words, how, now - (1 - factor) * budget.get(name, 0.0), (name,), is_bound=True)
        for name, (words, how, factor) in CHANGES.items()
    ]
    sampled = {name: key for name, key in SAMPLES.items() if budget.get(name)}
    for more in report.more_samples:
        if more.times == TIMES and sampled and follows_samples(report):
            words, how = "four times the samples", " and ".join(sampled.values())
            steps.append(NextStep(words, how, more.predicted_mse, tuple(sampled), seconds=more.seconds))
    return steps


def limit(report: RunReport) -> str:
    """Return what limits the error in half a sentence: the cause, its share, and a change that would reduce it."""
    if not report.verdict.trusted:
        return "unknown as long as the result is not to be trusted"
    now = report.error.predicted_mse
    if now <= 0:
        return "nothing: the predicted error is zero"
    name, part = max(report.error.budget.items(), key=lambda item: item[1])
    words = f"{cause(name)}, {100 * part / now:.0f} % of the predicted MSE"
    if name == "null_space":
        cure = "`ommatid design` weighs it against noise"
        return f"{words}; neither samples nor less noise reduce it ({cure})"
    step = next((step for step in steps_of(report) if name in step.causes), None)
    if step is None or (not step.is_bound and step.mse >= (1 - LEAST_GAIN) * now):
        return words
    how = "" if name in ("noise", "frames", "misalignment") else f" ({step.how})"
    return f"{words}; {step.change}{how}: RMS {sqrt(now):.3g} to {sqrt(step.mse):.3g} grey levels"


def error_words(mse: float, digits: int = 4) -> str:
    """Return a mean squared error with its root in grey levels: "4.399 (2.1 grey levels RMS)"."""
    return f"{mse:.{digits}g} ({sqrt(mse):.3g} grey levels RMS)"


def causes(budget: dict[str, float], mse: float) -> list[tuple[str, float, float]]:
    """Return the parts of a predicted squared error: cause, part, and share in per cent."""
    return [(cause(name), part, 100 * part / mse) for name, part in budget.items() if part > 0 and mse > 0]


def cause(name: str) -> str:
    """Return the name of a part of the error in words."""
    words = {
        "null_space": "null space of H",
        "noise": "sensor noise",
        "frames": "dark and flat frames",
        "rendering": "noise of the rendering",
        "detail": "detail finer than f",
        "calibration": "uncertainty of H",
        "misalignment": "misalignment of the lenses",
    }
    return words.get(name, name.replace("_", " "))


def held_out_rows(report: HeldOutReport) -> list[tuple[str, str]]:
    """Return names and values, the verdict first."""
    pixels = sum(entry.pixels for entry in report.sub_imagers)
    lines = [("verdict", _held_out_verdict(report)), ("prior", _prior_words(report.prior))]
    if not report.judged:
        return lines
    where = ""
    if report.windows.total > 1:
        where = f", in {report.windows.checked} of {report.windows.total} windows of the target"
    lines += [
        ("sub-imagers predicted", f"{report.judged} of {len(report.sub_imagers)}, {pixels} pixels{where}"),
        ("largest deviation", f"{_probability(report.p_value)}, among all sub-imagers"),
    ]
    worst = report.worst()
    shown = worst[: max(MOST_ROWS, sum(entry.named for entry in worst))]
    return lines + [(f"  {entry.name}", _entry_words(entry)) for entry in shown]


def _held_out_verdict(report: HeldOutReport) -> str:
    """Return the verdict as a sentence."""
    trusted, reasons = report.verdict.trusted, "; ".join(report.verdict.reasons)
    if trusted is None:
        return reasons
    if not trusted:
        return f"not to be trusted: {reasons}"
    return f"all {report.judged} sub-imagers agree with their predictions from the others"


def _entry_words(entry: HeldOutEntry) -> str:
    """Return z, probability and size of a sub-imager's error."""
    words = (
        f"z = {entry.z:.1f}, {_probability(entry.p_value)}, errs by {entry.rms_error:.3g} grey levels,"
        f" expected {entry.expected_rms:.3g}"
    )
    return f"{words}; contradicts the others" if entry.named else words


def _prior_words(prior: HeldOutPrior) -> str:
    """Return the prior that the predictions assumed, and where it came from."""
    length = "" if prior.correlation_length is None else f", correlation length {prior.correlation_length:.3g} mm"
    words = f"{prior.kind}, variance {prior.variance:.4g}{length}"
    if prior.fitted:
        return f"{words}, fitted to the stack"
    return f"{words}, as the scene says; a photograph is no draw of it"


def _probability(p_value: float | None) -> str:
    """Return a probability, also one that float64 takes for 0."""
    if p_value is None:
        return "p unknown"
    return f"p = {p_value:.2g}" if p_value >= LEAST else f"p < {LEAST:g}"
