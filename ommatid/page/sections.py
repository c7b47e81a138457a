"""The report of a run as one HTML page, and the content of its sections as the template takes it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import lru_cache
from math import sqrt
from typing import Any

import numpy as np
from markupsafe import Markup

from ommatid.analysis import held_out
from ommatid.analysis.averaging_kernel import ErrorWindow, error_window
from ommatid.analysis.next_steps import best_other_type, next_steps
from ommatid.bench.table import BenchTable
from ommatid.reconstruct.coarse_model import model_of_f
from ommatid.reconstruct.output import facts, verdict_words
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.estimation import PriorTable

from . import tables, words
from .data import ResultMaps, Run, ShownSubImage, maps, shown_sub_image
from .document import fill
from .panels import error_groups, resolution, time_curves
from .panels import maps as result_maps

DRAWN_TABLES = ("target", "camera", "world", "light")  # of the scene file, which the drawing shows
KEPT_DRAWINGS = 8


def page(run: Run, bench: BenchTable | None, stamp: str) -> str:
    """Return the report of a run as HTML.

    bench : results of `ommatid bench` for the camera
    stamp : fingerprint of the content, by which an up-to-date page is recognised
    """
    truth = None if run.truth is None else run.truth.astype(np.float64)
    single = shown_sub_image(run.stack, truth)
    shown = maps(run.estimate, run.variance, run.truth, single.image, run.others)
    model = model_of_f(run.model, run.stack.camera, PriorTable())
    window = error_window(run.stack, model, run.estimate.astype(np.float64), run.report)
    content = {
        **_head(run),
        **_images(shown, single, words.numbers_beside(run.report)),
        **_error(run, window),
        **resolution.content(run, model, window, single),
        **_held_out(run),
        **_time(run, bench),
        **_camera(run.stack.scene, run.stack.camera),
        "baselines": tables.baselines(run.report) if len(run.report.baselines) > 1 else None,
        "baseline_words": facts.baseline_words(run.report),
        "skipped": tables.skipped(run),
        "numbers": tables.numbers(run),
        "further": tables.further(run),
        "origins": tables.origins(run),
        "made": tables.made(run.report),
        "scene_text": tables.scene_text(run.stack.scene),
    }
    return fill("page.html", {**content, "folder": run.folder, "stamp": stamp})


def _head(run: Run) -> dict[str, Any]:
    report = run.report
    return {
        "title": run.title,
        "heading": verdict_words.heading(report),
        "sentence": words.sentence(report),
        "reasons": words.reasons(report),
        "grounds": words.grounds(report),
        "cautions": facts.on_topic(report, "caution"),
        "key_numbers": facts.on_topic(report, "error", "quality", "time"),
    }


def _images(shown: ResultMaps, single: ShownSubImage, numbers: dict[str, str]) -> dict[str, Any]:
    panels = result_maps.panels(shown, single.title, numbers)
    group = result_maps.group("maps", panels, shown.block, (shown.rows, shown.columns))
    return {
        "maps": shown,
        "panels": panels,
        "ratio": result_maps.ratio(shown.rows, shown.columns),
        "document": result_maps.document([group]),
    }


def _error(run: Run, window: ErrorWindow | None) -> dict[str, Any]:
    trusted = verdict_words.is_trusted(run.report)
    groups = error_groups.groups(run, window)
    other = best_other_type(run.stack.scene, window) if window is not None and trusted else None
    budget, steps = run.report.error.budget, next_steps(run.report, other)
    is_reduced = other is not None and any(str(other.magnification) in step.change for step in steps)
    largest = max(budget, key=lambda name: budget[name], default="")
    return {
        "budget": words.budget(run.report.error),
        "steps": steps,
        "now": run.report.error.predicted_mse,
        "root": sqrt,
        "remedy": words.largest_part(run.report) if trusted and largest == "null_space" and not is_reduced else "",
        "trusted": trusted,
        "error_groups": groups,
        "error_chart": error_groups.figure(groups) if groups else "",
        "error_words": error_groups.words(groups) if groups else "",
    }


def _held_out(run: Run) -> dict[str, Any]:
    report = run.report.held_out
    if report is None:
        return {"held_out": None}
    verdict = held_out.verdict(report)
    return {
        "held_out": report,
        "held_out_words": f"{verdict[:1].upper()}{verdict[1:]}",
        "held_out_prior": held_out.prior_words(report.prior),
        "held_out_maps": held_out.lens_type_maps(report),
    }


def _time(run: Run, bench: BenchTable | None) -> dict[str, Any]:
    curves, curve_words = time_curves.time_curves(run, bench)
    return {
        "curves": curves,
        "curve_words": curve_words,
        "stages": tables.stages(run),
    }


def _camera(scene: Scene, camera: Camera) -> dict[str, Any]:
    lenses, facts = tables.geometry(scene, camera)
    return {"lenses": lenses, "facts": facts, "drawing": drawing_of(scene, camera)}


@dataclass(frozen=True)
class DrawnCamera:
    """A camera and its scene, equal to another one that is drawn alike: one with the same `key`."""

    key: str
    scene: Scene = field(compare=False)
    camera: Camera = field(compare=False)


def drawing_of(scene: Scene, camera: Camera) -> Markup:
    """Return the drawing of a camera without title and table."""
    tables = scene.plain()
    key = json.dumps({name: tables[name] for name in DRAWN_TABLES if name in tables}, sort_keys=True, default=str)
    return _drawn(DrawnCamera(key, scene, camera))


@lru_cache(maxsize=KEPT_DRAWINGS)
def _drawn(drawn: DrawnCamera) -> Markup:
    from ommatid.figures.camera_drawing import camera_drawing
    from ommatid.figures.saving import svg_text

    return Markup(svg_text(camera_drawing(drawn.scene, drawn.camera, described=False), "camera-drawing"))
