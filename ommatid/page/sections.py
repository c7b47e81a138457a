"""The report of a run as one HTML page, and the content of its sections as the template takes it."""

from __future__ import annotations

import json
from math import sqrt
from typing import Any

import numpy as np
from markupsafe import Markup

from ommatid.analysis import depth_error, study, summary
from ommatid.analysis.averaging_kernel import ErrorWindow, error_window
from ommatid.analysis.next_steps import best_other_type, next_steps
from ommatid.bench.table import BenchTable
from ommatid.reconstruct.coarse_model import model_of_f
from ommatid.reconstruct.output import facts, verdict_words
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables import toml
from ommatid.scenes.tables.estimation import PriorTable

from . import charts
from . import maps as result_maps
from .data import MOST_MAPS, PageTable, Run, ShownSubImage, block_of, maps_of, shown_sub_image
from .document import fill

AGREEMENT = {
    "agrees": "The error is as expected for this image.",
    "worse": "The error is larger than expected for this image.",
    "better": "The error is smaller than expected for this image.",
    "unknown": "",
}
ELSEWHERE = "left out", "  from ", "MSE "  # beginnings of facts that other tables of the page show
DRAWN_TABLES = ("target", "camera", "world", "light")  # of the scene file, which the drawing shows
KEPT_DRAWINGS = 8


def page(run: Run, bench: BenchTable | None, stamp: str) -> str:
    """Return the report of a run as HTML.

    bench : results of `ommatid bench` for the camera
    stamp : fingerprint of the content, by which an up-to-date page is recognised
    """
    single = shown_sub_image(run)
    model = model_of_f(run.model, run.stack.camera, PriorTable())
    window = error_window(run.stack, model, run.estimate.astype(np.float64), run.report)
    curves, curve_words = charts.time_curves(run, bench)
    content = {
        **_head(run),
        **_images(run, single),
        **_error(run, window),
        **charts.resolution_content(run, model, window, single),
        "curves": curves,
        "curve_words": curve_words,
        **_camera(run.stack.scene, run.stack.camera),
        **_tables(run),
        **_origin(run),
    }
    return fill("page.html", {**content, "stamp": stamp})


def _head(run: Run) -> dict[str, Any]:
    report = run.report
    return {
        "title": run.title,
        "heading": verdict_words.heading(report),
        "sentence": sentence(report),
        "reasons": reasons(report),
        "grounds": grounds(report),
        "cautions": facts.on_topic(report, "caution"),
        "key_numbers": facts.on_topic(report, "error", "quality", "time"),
    }


def sentence(report: RunReport) -> str:
    """Return whether the error is as expected, or why the numbers below are of little use."""
    if not report.diagnostics.pixels_used:
        return "No sensor pixel could be used: the estimate is the prior, not an image."
    if not report.verdict.trusted:
        return "The figures below rest on assumptions that do not hold; resolve this first."
    return "The truth is not known." if report.error.mse is None else AGREEMENT[facts.agreement(report.error)]


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


def _images(run: Run, single: ShownSubImage) -> dict[str, Any]:
    block = block_of(run.estimate.shape, MOST_MAPS + len(run.others))
    maps = maps_of(run, block, single.image)
    others = {name: f"{title[:1].upper()}{title[1:]}" for name, title in facts.METHODS.items() if name in run.others}
    titles = {**result_maps.TITLES, "single": single.title, **others}
    panels = result_maps.panels(maps, titles, numbers_beside(run.report), result_maps.scales_of([maps]))
    shape = run.stack.camera.shape
    group = result_maps.group("maps", panels, block, shape)
    return {
        "shape": shape,
        "block": block,
        "panels": panels,
        "ratio": result_maps.ratio(*shape),
        "document": result_maps.document([group]),
    }


def _error(run: Run, window: ErrorWindow | None) -> dict[str, Any]:
    trusted = run.report.verdict.trusted
    groups = charts.error_groups(run, window)
    other = best_other_type(run.stack.scene, window) if window is not None and trusted else None
    budget, now, steps = run.report.error.budget, run.report.error.predicted_mse, next_steps(run.report, other)
    causes, limit = verdict_words.causes(budget, now), verdict_words.limit(run.report)
    is_reduced = other is not None and any(str(other.magnification) in step.change for step in steps)
    largest = max(budget, key=lambda name: budget[name], default="")
    return {
        "budget": sorted(causes, key=lambda each: -each[1]),
        "steps": steps,
        "now": now,
        "root": sqrt,
        "remedy": f"What limits the error: {limit}." if trusted and largest == "null_space" and not is_reduced else "",
        "trusted": trusted,
        "error_groups": groups,
        "error_chart": charts.error_chart(groups) if groups else "",
        "error_words": charts.error_words(groups) if groups else "",
    }


def _tables(run: Run) -> dict[str, Any]:
    """Return the tables of the page; those of facts without the facts that others show."""
    report = run.report
    every = [fact for fact in facts.facts(report) if fact.topic is None and not fact.name.startswith(ELSEWHERE)]
    skipped = [(each.what, facts.skipped_words(each.why, each.bound)) for each in report.skipped]
    found: dict[str, Any] = {
        "baselines": None,
        "held_out": None,
        "stages": PageTable("Stages of this run", ("stage", "time"), [f.row for f in facts.on_topic(report, "stage")]),
        "skipped": PageTable("Skipped effects", ("effect", "reason"), skipped),
        "numbers": PageTable("Other numbers", ("quantity", "value"), [(f.name.strip(), f.words) for f in every]),
        "further": list[PageTable](),
    }
    if len(report.baselines) > 1:
        header = "method", "mean squared error", "PSNR", "SSIM", "time"
        found["baselines"] = PageTable("The same stack by other methods", header, facts.baseline_rows(report))
    if report.held_out is not None:
        rows = verdict_words.held_out_rows(report.held_out)
        found["held_out"] = PageTable("Held-out check", ("quantity", "value"), rows)
    if report.depth:
        rows = depth_error.rows(report.depth)
        found["further"].append(PageTable("Error against distance", ("distance", "error"), rows))
    if report.study:
        rows = study.rows(report.study)
        found["further"].append(PageTable("The same stack with other models of H", ("H", "error"), rows))
    return found


def _origin(run: Run) -> dict[str, Any]:
    """Return what is needed to repeat the run, as far as run.json has it, and its scene file, defaults included."""
    report = run.report
    seeds = [(name, "none" if seed is None else str(seed)) for name, seed in report.seeds]
    known = [("date", report.date), ("command", " ".join(report.command)), ("host", report.host)]
    return {
        "origins": [
            PageTable("Seeds", ("random numbers", "seed"), seeds),
            PageTable("Versions", ("package", "version"), list(report.versions.items())),
        ],
        "made": [(name, value) for name, value in known if value],
        "scene_text": toml.dumps(run.stack.scene.plain()),
    }


def _geometry(scene: Scene, camera: Camera) -> tuple[PageTable, list[tuple[str, ...]]]:
    """Return a table of the lens types, and names and values of the other dimensions."""
    (_, dimensions), (_, lenses), *_ = summary.sections(summary.describe(Setup(scene, camera), "", None))
    header, *rows = lenses
    return PageTable("Lens types", header, rows), list(dimensions)


def _camera(scene: Scene, camera: Camera) -> dict[str, Any]:
    lenses, dimensions = _geometry(scene, camera)
    return {"lenses": lenses, "facts": dimensions, "drawing": drawing_of(scene, camera)}


_drawings = dict[str, Markup]()  # by what they show: the scenes of a sweep often have one camera


def drawing_of(scene: Scene, camera: Camera) -> Markup:
    """Return the drawing of a camera without title and table."""
    from ommatid.figures.camera_drawing import camera_drawing
    from ommatid.figures.saving import svg_text

    tables = scene.plain()
    key = json.dumps({name: tables[name] for name in DRAWN_TABLES if name in tables}, sort_keys=True, default=str)
    if key not in _drawings:
        if len(_drawings) == KEPT_DRAWINGS:
            _drawings.clear()
        _drawings[key] = Markup(svg_text(camera_drawing(scene, camera, described=False), "camera-drawing"))
    return _drawings[key]
