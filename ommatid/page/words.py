"""Sentences of a report: agreement of the error with theory, resolution, and the largest contribution to the error."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from typing import Any

from ommatid.reconstruct.output import verdict_words
from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.output.verdict_words import cause, is_trusted, limit

SCALE = "on a scale of 0 to 255"


def sentence(report: RunReport) -> str:
    """Return the main result: the error, whether it is as expected, and the gain over a single sub-image."""
    if not report.diagnostics.pixels_used:
        return "No sensor pixel could be used: the estimate is the prior, not an image."
    words = _error(report.error)
    if not is_trusted(report):
        return f"{words} The figures below rest on assumptions that do not hold; resolve this first."
    baseline, gain = report.error.baseline, report.error.gain
    if baseline is None or gain is None or gain < 0:  # which is a doubt
        return words
    return f"{words} That is {gain:.1f} dB better than the best single sub-image, {baseline.sub_imager}."


def reasons(report: RunReport) -> list[str]:
    """Return what speaks against the result, one sentence for each reason or doubt."""
    verdict = report.verdict
    return [] if verdict is None else [_sentence(words) for words in verdict.reasons or verdict.doubts]


def grounds(report: RunReport) -> list[str]:
    """Return what the verdict of a result that can be trusted rests on, one sentence for each passed check."""
    if not is_trusted(report):
        return []
    passed = () if report.verdict is None else report.verdict.passed
    return [_sentence(words) for words in passed or (verdict_words.grounds(report),)]


def notes(report: RunReport) -> list[str]:
    """Return the notes of the verdict as sentences."""
    return [] if report.verdict is None else [_sentence(words) for words in report.verdict.notes]


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def _error(error: ErrorReport) -> str:
    predicted = sqrt(error.predicted_mse)
    if error.mse is None:
        words = f"The truth is not known; the predicted RMS error of a pixel is {predicted:.3g} {SCALE}"
        given = error.expected_given_estimate
        least = "" if given is None else f" for images of the prior, and {sqrt(given):.3g} if the image is the estimate"
        return f"{words}{least}."
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
    return warnings


def assumptions(report: RunReport) -> list[str]:
    """Return what the run assumed, one sentence each."""
    return [f"Assumed: {assumption}." for assumption in report.assumes]


def key_numbers(report: RunReport) -> list[tuple[str, str, str]]:
    """Return the numbers at the top of the page: name, value, and the value to compare it with."""
    error, predicted = report.error, sqrt(report.error.predicted_mse)
    numbers: list[tuple[str, str, str]] = []
    if error.mse is None:
        numbers.append(("Predicted RMS error", f"{predicted:.3g}", f"of 255; MSE {error.predicted_mse:.4g}"))
    else:
        expected = error.predicted_mse if error.expected_given_truth is None else error.expected_given_truth.mse
        against = f"of 255; expected {sqrt(expected):.3g}"
        numbers.append(("RMS error", f"{sqrt(error.mse):.3g}", against))
        numbers.append(("Mean squared error", f"{error.mse:.4g}", f"expected {expected:.4g}"))
        psnr = "exact" if error.psnr is None else f"{error.psnr:.1f} dB"
        numbers.append(("PSNR", psnr, _beside(error, "psnr", "{:.1f} dB", "for a peak of 255")))
        if error.ssim is not None:
            numbers.append(("SSIM", f"{error.ssim:.4f}", _beside(error, "ssim", "{:.4f}", "1 if identical")))
    seconds = sum(stage.seconds for stage in report.stages.values())
    sizes = f"{report.measurements} measurements, {report.unknowns} unknowns"
    return [*numbers, ("Computing time", f"{seconds:.3g} s", sizes)]


def _beside(error: ErrorReport, name: str, form: str, otherwise: str) -> str:
    value = None if error.baseline is None else getattr(error.baseline, name)
    return otherwise if value is None else f"single sub-image: {form.format(value)}"


def numbers_beside(report: RunReport) -> dict[str, str]:
    """Return the figures beside the titles of the maps, by the name of the map."""
    error = report.error
    numbers = {"deviation": f"RMS {sqrt(error.predicted_mse):.3g}"}
    if error.mse is not None:
        numbers["error"] = f"RMS {sqrt(error.mse):.3g}"
    if error.psnr is not None:
        gain = "" if error.gain is None else f" ({error.gain:+.1f} dB)"
        numbers["estimate"] = f"{error.psnr:.1f} dB{gain}"
    if error.baseline is not None and error.baseline.psnr is not None:
        numbers["single"] = f"{error.baseline.psnr:.1f} dB"
    return numbers


def contents(parts: Mapping[str, Any]) -> str:
    """Return what a folder without a complete run holds; parts : of a run, by the fields of `data.Run`."""
    names = {"a stack": "stack", "a model of H": "model", "an estimate": "estimate"}
    held = [words for words, name in names.items() if name in parts]
    missing = [words for words, name in names.items() if name not in parts]
    words = f"This folder holds {' and '.join(held)}, and no finished run: there is no verdict"
    return f"{words}. Missing: {', '.join([*missing, 'run.json'])}."


def budget(error: ErrorReport) -> list[tuple[str, float, float]]:
    """Return the parts of the predicted squared error, the largest first: cause, part, share in per cent."""
    parts = sorted(error.budget.items(), key=lambda item: -item[1])
    return [(cause(name), part, 100 * part / error.predicted_mse) for name, part in parts if part > 0]


def largest_part(report: RunReport) -> str:
    """Return the largest part of the predicted error and a change that would reduce it, as a sentence."""
    return f"What limits the error: {limit(report)}."
