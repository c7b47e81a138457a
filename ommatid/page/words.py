"""Sentences of a page: the verdict, what to know before the numbers, and the largest contribution to the error."""

from __future__ import annotations

from math import sqrt

from ommatid.reconstruct.output import verdict_words
from ommatid.reconstruct.output.facts import agreement
from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.output.verdict_words import cause, is_trusted, limit

AGREEMENT = {
    "agrees": "The error is as expected for this image.",
    "worse": "The error is larger than expected for this image.",
    "better": "The error is smaller than expected for this image.",
    "unknown": "",
}


def sentence(report: RunReport) -> str:
    """Return whether the error is as expected, or why the numbers below are of little use."""
    if not report.diagnostics.pixels_used:
        return "No sensor pixel could be used: the estimate is the prior, not an image."
    if not is_trusted(report):
        return "The figures below rest on assumptions that do not hold; resolve this first."
    return "The truth is not known." if report.error.mse is None else AGREEMENT[agreement(report.error)]


def reasons(report: RunReport) -> list[str]:
    """Return what speaks against the result, one sentence for each reason or doubt."""
    verdict = report.verdict
    return [_sentence(words) for words in verdict.reasons or verdict.doubts]


def grounds(report: RunReport) -> list[str]:
    """Return what the verdict rests on: passed checks of a result that can be trusted, notes, and assumptions."""
    verdict = report.verdict
    checked = (verdict.passed or (verdict_words.grounds(report),)) if verdict.trusted else ()
    return [_sentence(words) for words in (*checked, *verdict.notes, *(f"assumed: {each}" for each in report.assumes))]


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def numbers_beside(report: RunReport) -> dict[str, str]:
    """Return the figures beside the titles of the maps, by the name of the map."""
    error = report.error
    numbers = {"deviation": f"RMS {sqrt(error.predicted_mse):.3g}"}
    if error.mse is not None:
        numbers["error"] = f"RMS {sqrt(error.mse):.3g}"
    if error.psnr is not None:
        gain = "" if error.gain is None else f" ({error.gain:+.1f} dB)"
        numbers["estimate"] = f"{error.psnr:.1f} dB{gain}"
    for each in report.baselines:
        if each.psnr is not None:
            numbers[each.method] = f"{each.psnr:.1f} dB"
    return numbers


def budget(error: ErrorReport) -> list[tuple[str, float, float]]:
    """Return the parts of the predicted squared error, the largest first: cause, part, share in per cent."""
    parts = sorted(error.budget.items(), key=lambda item: -item[1])
    return [(cause(name), part, 100 * part / error.predicted_mse) for name, part in parts if part > 0]


def largest_part(report: RunReport) -> str:
    """Return the largest part of the predicted error and a change that would reduce it, as a sentence."""
    return f"What limits the error: {limit(report)}."
