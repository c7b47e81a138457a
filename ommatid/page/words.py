"""A run in words: one sentence on whether it is right, how sharp it is, and what limits it."""

from __future__ import annotations

from math import sqrt

from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.restore import MAX_SPURIOUS_INFORMATION

CAUSES = {
    "null_space": ("what no lens sees", "another lens type would help; `ommatid design` ranks them"),
    "noise": ("the sensor's noise", "only more light or a better sensor would help"),
    "quantisation": ("the sensor's bits", "more of them would help"),
    "rendering": ("the noise of the rendering itself", "more render.samples would help"),
    "calibration": ("how well H is known", "more calibration.samples would help"),
    "misalignment": ("where the lenses really stand", "a calibration would help"),
}


def verdict(report: RunReport) -> str:
    """The run in one sentence: measured against expected error, sharpness, and what limits it."""
    if not report.diagnostics.pixels_used:
        return "No sensor pixel is left, so what is shown is the prior, not an image."
    return f"{_error(report.error)}; {_sharpness(report)}; {_limit(report.error)}."


def _error(error: ErrorReport) -> str:
    predicted = sqrt(error.predicted_mse)
    if error.mse is None:
        return f"The truth is not known; theory expects pixels to be off by {predicted:.3g} of 255 (rms)"
    told = f"Pixels are off by {sqrt(error.mse):.3g} of 255 (rms)"
    given = error.expected_given_truth
    if given is None:
        return f"{told}, where theory expects {predicted:.3g} on average over all pictures"
    between = f"{sqrt(given.mse):.3g}, and {sqrt(given.low):.3g} to {sqrt(given.high):.3g} in 99 of 100 runs"
    said = {
        "agrees": "as theory expects of this picture",
        "worse": "more than theory allows for this picture",
        "better": "less than theory expects of this picture",
    }[agreement(error)]
    return f"{told}, {said} ({between})"


def agreement(error: ErrorReport) -> str:
    """Whether the measured error is what theory expects: agrees, worse, better or, where it cannot be told, unknown."""
    given, mse = error.expected_given_truth, error.mse
    if given is None or mse is None:
        return "unknown"
    if mse > given.high:
        return "worse"
    return "agrees" if mse >= given.low else "better"


def _sharpness(report: RunReport) -> str:
    width = report.diagnostics.resolution
    if width is None:
        return "nothing is resolved"
    pixels = f"{width:.2g} {'pixel' if f'{width:.2g}' == '1' else 'pixels'}"
    if width < 1.05:
        return f"it is as sharp as the target's grid ({pixels})"
    return f"it is resolved to {pixels} of the target"


def _limit(error: ErrorReport) -> str:
    total = error.predicted_mse
    if total <= 0:
        return "nothing limits it"
    name, part = max(error.budget.items(), key=lambda item: item[1])
    cause, cure = CAUSES.get(name, (name.replace("_", " "), "see the table of its parts"))
    return f"what limits it most is {cause}, {100 * part / total:.0f} % of the expected squared error: {cure}"


def cautions(report: RunReport) -> list[str]:
    """What a reader should know before the numbers are trusted, a sentence each."""
    found: list[str] = []
    diagnostics = report.diagnostics
    if report.model.spurious_information > MAX_SPURIOUS_INFORMATION:
        found.append(
            "Do not trust the predicted error: the lens types leave pixels open, and the noise of H looks like"
            " information on them."
        )
    if diagnostics.fit_doubtful:
        found.append("Do not trust the prior or noise that was found: the stack does not tell it.")
    if diagnostics.pixels_dead or diagnostics.pixels_saturated:
        found.append(
            f"{diagnostics.pixels_dead} dead and {diagnostics.pixels_saturated} saturated sensor pixels are left"
            " out of the estimate."
        )
    return found


def key_numbers(report: RunReport) -> list[tuple[str, str, str]]:
    """What stands large at the top: a name, a number, and what it is compared with."""
    error, stages = report.error, report.stages
    found: list[tuple[str, str, str]] = []
    if error.mse is not None:
        found.append(("Mean squared error", f"{error.mse:.4g}", f"predicted {error.predicted_mse:.4g}"))
        psnr = "exact" if error.psnr is None else f"{error.psnr:.2f} dB"
        found.append(("PSNR", psnr, "peak 255"))
        if error.ssim is not None:
            found.append(("Structural similarity", f"{error.ssim:.4f}", "1 is the truth itself"))
    else:
        found.append(("Predicted squared error", f"{error.predicted_mse:.4g}", "a pixel, Eq. 5"))
    seconds = sum(stage.seconds for stage in stages.values())
    counted = f"{report.measurements} measurements, {report.unknowns} unknowns"
    return [*found, ("Time", f"{seconds:.3g} s", counted)]


def budget(error: ErrorReport) -> list[tuple[str, float, float]]:
    """Parts of the expected squared error, the largest first: cause, part, share of the whole in per cent."""
    total = error.predicted_mse
    parts = sorted(error.budget.items(), key=lambda item: -item[1])
    return [
        (CAUSES.get(name, (name.replace("_", " "), ""))[0], part, 100 * part / total)
        for name, part in parts
        if part > 0
    ]
