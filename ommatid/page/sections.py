"""Content of the sections of a page, as its template takes it."""

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
from ommatid.reconstruct.detail.detailed_model import model_of_f
from ommatid.reconstruct.output import verdict_words
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

from . import tables, words
from .data import Contents, ResultMaps, Run, ShownSubImage, maps, shown_sub_image
from .panels import error_groups, point_response, resolution, sensor, time_curves
from .panels import maps as result_maps
from .panels.point_response import IdealMatrix

DRAWN_TABLES = ("target", "camera", "world", "light")  # of the scene file, which the drawing shows
KEPT_DRAWINGS = 8


def of_run(run: Run, ideal: IdealMatrix | None, bench: BenchTable | None) -> dict[str, Any]:
    """Return the content of a run's page but for its sensor."""
    truth = None if run.truth is None else run.truth.astype(np.float64)
    single = shown_sub_image(run.stack, truth)
    shown = maps(run.estimate, run.variance, run.truth, single.image)
    model = model_of_f(run.model, run.stack.camera, PriorTable())
    window = error_window(run.stack, model, run.estimate.astype(np.float64), run.report)
    images, responses = _images(shown, single, words.numbers_beside(run.report)), _responses(model, ideal)
    return {
        **_head(run),
        **images,
        **_error(run, window),
        **resolution.content(run, model, window, single),
        **_held_out(run),
        **responses,
        "groups": images["groups"] + responses["groups"],
        **_time(run, bench),
        **_camera(run.stack.scene, run.stack.camera),
        "skipped": tables.skipped(run),
        "numbers": tables.numbers(run),
        "further": tables.further(run),
        "origins": tables.origins(run),
        "made": tables.made(run.report),
        "scene_text": tables.scene_text(run.stack.scene),
    }


def of_sensor(stack: Stack, groups: list[dict[str, Any]], most: int) -> dict[str, Any]:
    """Return the sensor's section and the data of all maps; most : number of sensor values."""
    mosaic = sensor.mosaic(stack, most)
    return {
        "mosaic": mosaic,
        "mosaic_words": sensor.words(mosaic),
        "document": result_maps.document([*groups, sensor.group(mosaic)]),
    }


def of_contents(contents: Contents) -> dict[str, Any]:
    """Return the content of the page of a folder without a complete run."""
    described = next((part for part in (contents.stack, contents.model) if part is not None), None)
    groups: list[dict[str, Any]] = []
    content: dict[str, Any] = {"title": contents.title, "words": words.contents(contents), "maps": None}
    content |= {"mosaic": None, "responses": [], "drawing": None, "lenses": None, "scene_text": ""}
    if contents.estimate is not None:
        shown = maps(contents.estimate, contents.variance, contents.truth)
        content |= _images(shown, None, {})
        groups += content["groups"]
    if contents.model is not None:
        responses = _responses(contents.model, None)
        groups += responses["groups"]
        content |= responses
    if described is not None:
        content |= _camera(described.scene, described.camera)
        content["scene_text"] = tables.scene_text(described.scene)
    content["document"] = result_maps.document(groups)
    return content if contents.stack is None else content | of_sensor(contents.stack, groups, sensor.MOST_VALUES)


def _head(run: Run) -> dict[str, Any]:
    report = run.report
    trusted = verdict_words.is_trusted(report)
    return {
        "title": run.title,
        "heading": verdict_words.heading(report),
        "sentence": words.sentence(report),
        "reasons": [] if trusted else words.grounds(report),
        "grounds": words.grounds(report) if trusted else [],
        "notes": words.notes(report),
        "cautions": words.cautions(report),
        "assumptions": words.assumptions(report),
        "key_numbers": words.key_numbers(report),
    }


def _images(shown: ResultMaps, single: ShownSubImage | None, numbers: dict[str, str]) -> dict[str, Any]:
    panels = result_maps.panels(shown, "" if single is None else single.title, numbers)
    group = result_maps.group("maps", panels, shown.block, (shown.rows, shown.columns))
    names = [panel.name for panel in panels]
    pair = next(pair for pair in (("single", "estimate"), ("estimate", "deviation")) if pair[0] in names)
    return {
        "maps": shown,
        "panels": panels,
        "compared": pair if pair[1] in names else None,
        "ratio": result_maps.ratio(shown.rows, shown.columns),
        "groups": [group],
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
    rows = held_out.rows(report)
    return {
        "held_out": report,
        "held_out_words": f"{rows[0][1][:1].upper()}{rows[0][1][1:]}",
        "held_out_prior": held_out.prior_words(report.prior),
        "held_out_maps": held_out.lens_type_maps(report),
        "held_out_table": tables.held_out(rows),
    }


def _responses(model: Model, ideal: IdealMatrix | None) -> dict[str, Any]:
    """Return the responses with their panels, and their groups of maps."""
    responses = point_response.responses(model, ideal)
    panels = [point_response.panels(response) for response in responses]
    groups = [
        result_maps.group(f"response-{response.lens}", shown, 1, response.maps["measured"].shape)
        for response, shown in zip(responses, panels, strict=True)
    ]
    described = [point_response.words(response) for response in responses]
    return {"responses": list(zip(responses, described, panels, strict=True)), "groups": groups}


def _time(run: Run, bench: BenchTable | None) -> dict[str, Any]:
    curves = time_curves.time_curves(run, bench)
    return {
        "curves": time_curves.figure(curves) if curves else "",
        "curve_words": time_curves.words(curves) if curves else "",
        "stages": tables.stages(run),
        "more_samples": tables.more_samples(run),
        "time_limit": tables.time_limit(run),
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

    return Markup(svg_text(camera_drawing(drawn.scene, drawn.camera, described=False)))
