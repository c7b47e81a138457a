"""The verdict on a run in words, and what would reduce its error, as far as its numbers tell."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from ..verdict.verdict import SPURIOUS_SHARE
from .run_json import RunReport

TIMES = 4  # as many samples, in the sentence on more samples
LEAST_GAIN = 0.05  # relative fall of the error from which a change is worth a sentence


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


def is_trusted(report: RunReport) -> bool:
    """Return True unless the verdict says that the error bars are not to be trusted."""
    return report.verdict.trusted


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


def limit(report: RunReport) -> str:
    """Return what limits the error in half a sentence: the cause, its share, and a change that would reduce it."""
    if not is_trusted(report):
        return "unknown as long as the result is not to be trusted"
    if report.error.predicted_mse <= 0:
        return "nothing: the predicted error is zero"
    error = report.error
    name, part = max(error.budget.items(), key=lambda item: item[1])
    change = _change(name, part, report)
    return f"{cause(name)}, {100 * part / error.predicted_mse:.0f} % of the predicted MSE{change}"


def error_words(mse: float, digits: int = 4) -> str:
    """Return a mean squared error with its root in grey levels: "4.399 (2.1 grey levels RMS)"."""
    return f"{mse:.{digits}g} ({sqrt(mse):.3g} grey levels RMS)"


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


def _change(name: str, part: float, report: RunReport) -> str:
    error, now = report.error, report.error.predicted_mse
    if name == "null_space":
        return "; neither samples nor less noise reduce it (`ommatid design` weighs it against noise)"
    if name in CHANGES:
        change = CHANGES[name]
        words = f"{change.words} ({change.how})" if name == "quantisation" else change.words
        return f"; {words}: {_fall(now, now - (1 - change.factor) * part)}"
    if name not in SAMPLES or not follows_samples(report):
        return ""
    more = next((more for more in report.more_samples if more.times == TIMES), None)
    if more is not None and more.predicted_mse < (1 - LEAST_GAIN) * now:
        keys = " and ".join(key for part_name, key in SAMPLES.items() if error.budget.get(part_name))
        return f"; four times the samples ({keys}): {_fall(now, more.predicted_mse)}"
    return ""


def _fall(now: float, then: float) -> str:
    return f"RMS {sqrt(now):.3g} to {sqrt(then):.3g} grey levels"
