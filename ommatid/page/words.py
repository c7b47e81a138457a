"""Sentences of a report: agreement of the error with theory, resolution, and the largest contribution to the error."""

from __future__ import annotations

from math import sqrt

from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.restore import MAX_SPURIOUS_INFORMATION

SCALE = "on a scale of 0 to 255"
# Cause of a part of the predicted error, and the remedy:
CAUSES = {
    "null_space": ("null space of H", "another lens type would reduce it (`ommatid design` ranks candidates)"),
    "noise": ("sensor noise", "only more light or a better sensor would reduce it"),
    "quantisation": ("quantisation", "more bits would reduce it"),
    "rendering": ("noise of the rendering", "a larger `render.samples` would reduce it"),
    "calibration": ("uncertainty of H", "a larger `calibration.samples` would reduce it"),
    "misalignment": ("misalignment of the lenses", "a calibration would remove it"),
}


def verdict(report: RunReport) -> str:
    """Return the main results in three sentences: measured against expected error, resolution, largest cause."""
    if not report.diagnostics.pixels_used:
        return "No sensor pixel could be used: the estimate is the prior, not an image."
    return f"{_error(report.error)} {_resolution(report)} {_largest_cause(report.error)}"


def _error(error: ErrorReport) -> str:
    predicted = sqrt(error.predicted_mse)
    if error.mse is None:
        return f"The truth is not known; the predicted RMS error of a pixel is {predicted:.3g} {SCALE}."
    measured = f"The RMS error of a pixel is {sqrt(error.mse):.3g} {SCALE}"
    given = error.expected_given_truth
    if given is None:
        return f"{measured}; the predicted error, averaged over all images, is {predicted:.3g}."
    interval = f"expected: {sqrt(given.mse):.3g}; 99 % interval: {sqrt(given.low):.3g} to {sqrt(given.high):.3g}"
    comparison = {
        "agrees": "as expected for this image",
        "worse": "more than expected for this image",
        "better": "less than expected for this image",
    }[agreement(error)]
    return f"{measured}, {comparison} ({interval})."


def agreement(error: ErrorReport) -> str:
    """Return how the measured error compares with the expected interval: agrees, worse, better or unknown."""
    given = error.expected_given_truth
    if given is None or error.mse is None:
        return "unknown"
    if error.mse > given.high:
        return "worse"
    return "agrees" if error.mse >= given.low else "better"


def _resolution(report: RunReport) -> str:
    width = report.diagnostics.resolution
    if width is None:
        return "Nothing is resolved."
    pixels = f"{width:.2g} {'pixel' if f'{width:.2g}' == '1' else 'pixels'}"
    if width < 1.05:
        return f"The median resolution is that of the target's pixel grid ({pixels})."
    return f"The median resolution is {pixels} of the target."


def _largest_cause(error: ErrorReport) -> str:
    total = error.predicted_mse
    if total <= 0:
        return "The predicted error is zero."
    name, part = max(error.budget.items(), key=lambda item: item[1])
    cause, remedy = CAUSES.get(name, (name.replace("_", " "), "see the error budget"))
    return f"Largest part of the predicted squared error: {cause}, {100 * part / total:.0f} %; {remedy}."


def cautions(report: RunReport) -> list[str]:
    """Return warnings that a reader needs before the numbers, one sentence each."""
    warnings: list[str] = []
    diagnostics = report.diagnostics
    if report.model.spurious_information > MAX_SPURIOUS_INFORMATION:
        warnings.append(
            "Do not trust the predicted error: the lens types leave pixels undetermined, and the noise of H adds"
            " spurious information about them."
        )
    if diagnostics.fit_doubtful:
        warnings.append("Do not trust the fitted prior or noise: the stack does not determine them.")
    if diagnostics.pixels_dead or diagnostics.pixels_saturated:
        warnings.append(
            f"{diagnostics.pixels_dead} dead and {diagnostics.pixels_saturated} saturated sensor pixels are excluded"
            " from the estimate."
        )
    return warnings


def key_numbers(report: RunReport) -> list[tuple[str, str, str]]:
    """Return the numbers at the top of the page: name, value, and the value to compare it with."""
    error = report.error
    numbers: list[tuple[str, str, str]] = []
    if error.mse is None:
        numbers.append(("Predicted mean squared error", f"{error.predicted_mse:.4g}", "Eq. 5"))
    else:
        numbers.append(("Mean squared error", f"{error.mse:.4g}", f"predicted: {error.predicted_mse:.4g}"))
        psnr = "exact" if error.psnr is None else f"{error.psnr:.2f} dB"
        numbers.append(("PSNR", psnr, "for a peak of 255"))
        if error.ssim is not None:
            numbers.append(("Structural similarity", f"{error.ssim:.4f}", "1 for identical images"))
    seconds = sum(stage.seconds for stage in report.stages.values())
    sizes = f"{report.measurements} measurements, {report.unknowns} unknowns"
    return [*numbers, ("Run time", f"{seconds:.3g} s", sizes)]


def budget(error: ErrorReport) -> list[tuple[str, float, float]]:
    """Return the parts of the predicted squared error, the largest first: cause, part, share in per cent."""
    parts = sorted(error.budget.items(), key=lambda item: -item[1])
    return [
        (CAUSES.get(name, (name.replace("_", " "), ""))[0], part, 100 * part / error.predicted_mse)
        for name, part in parts
        if part > 0
    ]
