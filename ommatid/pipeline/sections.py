"""What commands print of each result: tables, and the lines of a run."""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from typing import Any

from ommatid.analysis import depth_error, predict, prediction_table, run_table, study, summary
from ommatid.analysis.run_table import region_row
from ommatid.analysis.summary import Section
from ommatid.reconstruct.output.run_json import ErrorReport, RunReport
from ommatid.reconstruct.output.verdict_words import grounds, heading, limit
from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.printable import printable
from ommatid.scenes.scene import Scene
from ommatid.simulate import world_view


def run_sections(folder: Path, description: dict[str, Any]) -> list[Section]:
    """Tabulate the description of a finished run in `folder`."""
    report = RunReport.model_validate(description)
    sections: list[Section] = [(f"{printable(report.title or folder.name)}: {folder}", run_table.rows(report))]
    if report.depth:
        sections.append(("Error against distance", depth_error.rows(report.depth)))
    if report.study:
        sections.append(("The same stack with other models of H", study.rows(report.study)))
    return sections


def scene_sections(description: dict[str, Any]) -> list[Section]:
    """Tabulate the description of a scene: geometry, lens types, electrons, plan, skipped effects."""
    geometry, lenses, *others = summary.sections(description)
    world = description.get("world")
    worlds: list[Section] = [] if world is None else [("World", world_view.rows(world))]
    return [geometry, *worlds, lenses, *_light_sections(description), *others]


def prediction_sections(scene: Scene, prediction: Prediction, light: dict[str, Any] | None) -> list[Section]:
    """Tabulate a prediction, and the electrons that the pixels collect where the scene has a sensor."""
    lines, tolerance = prediction_table.rows(prediction), scene.camera.tolerance
    if (
        any(sentence.startswith(predict.LEFT_OUT) for sentence in prediction.assumes)
        and tolerance is not None
        and prediction.misalignment is None
        and scene.estimator.misalignment == "trust"
    ):
        lines.append(("misalignment", "not included; it is predicted for small targets and sharp lenses only"))
    return [(printable(scene.title or scene.source.stem), lines), *_light_sections({"light": light} if light else {})]


def backend_sections(description: dict[str, Any]) -> list[Section]:
    """Tabulate the rendering backends and the versions of the libraries."""
    backends = [
        (backend["variant"], backend["reason"] or f"works, {backend['samples_per_second'] / 1e6:.0f} million samples/s")
        for backend in description["backends"]
    ]
    return [("Backends", backends), ("Versions", list(description["versions"].items()))]


def _light_sections(description: dict[str, Any]) -> list[Section]:
    return [("Electrons", summary.light_rows(description["light"]))] if "light" in description else []


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
        alike = error.expected_given_estimate
        least = "" if alike is None else f" for images of the prior, {sqrt(alike):.3g} if the image is the estimate"
        return f"expected {sqrt(mse):.3g} grey levels RMS (MSE {mse:.4g}){least}; the truth is not known"
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
    stages = ", ".join(f"{names[name]} {stage.seconds:.1f} s" for name, stage in report.stages.items())
    return f"{sum(stage.seconds for stage in report.stages.values()):.1f} s: {stages}"
