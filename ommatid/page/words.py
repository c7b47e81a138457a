"""Sentences of a report: agreement of the error with theory, resolution, and the largest contribution to the error."""

from __future__ import annotations

from math import sqrt

from ommatid.reconstruct.output import verdict_words
from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.output.verdict_words import cause, is_trusted, remedy

SCALE = "on a scale of 0 to 255"


def summary(report: RunReport) -> str:
    """Return the main results in three sentences: measured against expected error, resolution, largest cause.

    Where the verdict is against trust, only the first, and nothing of limits or remedies.
    """
    if not report.diagnostics.pixels_used:
        return "No sensor pixel could be used: the estimate is the prior, not an image."
    if not is_trusted(report):
        return f"{_error(report.error)} The figures below rest on assumptions that do not hold; resolve this first."
    return f"{_error(report.error)} {_resolution(report)} {remedy(report)}"


def grounds(report: RunReport) -> list[str]:
    """Return what the verdict rests on, one sentence for each reason or passed check."""
    verdict = report.verdict
    listed = [verdict_words.grounds(report)] if verdict is None else list(verdict.reasons or verdict.passed)
    return [_sentence(words) for words in listed or [verdict_words.grounds(report)]]


def notes(report: RunReport) -> list[str]:
    """Return the notes of the verdict as sentences."""
    return [] if report.verdict is None else [_sentence(words) for words in report.verdict.notes]


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


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


def cautions(report: RunReport) -> list[str]:
    """Return warnings that a reader needs before the numbers, one sentence each."""
    warnings: list[str] = []
    diagnostics = report.diagnostics
    if diagnostics.pixels_dead:
        warnings.append(f"{diagnostics.pixels_dead} dead sensor pixels are excluded from the estimate.")
    if diagnostics.pixels_saturated:
        warnings.append(
            f"{diagnostics.pixels_saturated} saturated sensor pixels count as readings of at least the limit."
        )
    return warnings + [f"Assumed: {assumption}." for assumption in report.assumes]


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
    return [(cause(name), part, 100 * part / error.predicted_mse) for name, part in parts if part > 0]
