"""The lines that `run` and `reconstruct` print of a result, from the content of run.json."""

from __future__ import annotations

from math import sqrt
from pathlib import Path

from ommatid.analysis.run_table import region_row
from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.output.verdict_words import grounds, heading, limit


def verdict_line(name: str, report: RunReport) -> str:
    """Return the name of a result and its verdict."""
    return f"{name}: {heading(report)}: {grounds(report)}"


def summary_lines(name: str, report: RunReport, page: Path | None) -> list[str]:
    """Return six lines: verdict, error against expectation, quality, what limits the error, time, and the page.

    A line for each region follows, if means of regions were asked for.
    """
    rows = {
        "error": _error(report.error),
        "quality": _quality(report),
        "limit": limit(report),
        "time": _time(report),
        "page": "none is written with the estimate alone; name a folder with -o" if page is None else str(page),
    }
    regions = [f"  {'region':8} {name} is {mean}" for name, mean in map(region_row, report.regions)]
    return [verdict_line(name, report), *(f"  {label:8} {words}" for label, words in rows.items()), *regions]


def _error(error: ErrorReport) -> str:
    given = error.expected_given_truth
    mse = error.predicted_mse if given is None else given.mse
    interval = "" if given is None else f", 99 %: {given.low:.4g} to {given.high:.4g}"
    if error.mse is None:
        return f"expected {sqrt(mse):.3g} grey levels RMS (MSE {mse:.4g}); the truth is not known"
    measured = f"{sqrt(error.mse):.3g} grey levels RMS (MSE {error.mse:.4g})"
    return f"{measured}, expected {sqrt(mse):.3g} (MSE {mse:.4g}{interval})"


def _quality(report: RunReport) -> str:
    error, baseline = report.error, report.error.baseline
    if error.mse is None:
        width = report.diagnostics.resolution
        resolved = "nothing is resolved" if width is None else f"resolution {width:.3g} pixels of f"
        return f"{resolved}, {report.diagnostics.degrees_of_freedom:.4g} of {report.unknowns} degrees of freedom"
    words = _psnr_and_ssim(error.psnr, error.ssim)
    if baseline is None:
        return words
    gain = "against"
    if error.gain is not None:
        gain = f"{abs(error.gain):.1f} dB {'better' if error.gain >= 0 else 'worse'} than"
    single = _psnr_and_ssim(baseline.psnr, baseline.ssim)
    return f"{words}; {gain} the best single sub-image ({baseline.sub_imager}: {single})"


def _psnr_and_ssim(psnr: float | None, ssim: float | None) -> str:
    words = "exact" if psnr is None else f"PSNR {psnr:.1f} dB"
    return words if ssim is None else f"{words}, SSIM {ssim:.4f}"


def _time(report: RunReport) -> str:
    names = {name: "import" if stage.method == "imported" else name for name, stage in report.stages.items()}
    stages = ", ".join(f"{names[name]} {stage.seconds:.1f}" for name, stage in report.stages.items())
    return f"{sum(stage.seconds for stage in report.stages.values()):.1f} s: {stages}"
