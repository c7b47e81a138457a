"""The tables that commands print of each result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ommatid.analysis import depth_error, predict, prediction_table, study, summary
from ommatid.analysis.summary import Section
from ommatid.reconstruct.output import facts
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.printable import printable
from ommatid.scenes.scene import Scene
from ommatid.simulate import world_view


def run_sections(folder: Path, description: dict[str, Any]) -> list[Section]:
    """Tabulate the description of a finished run in `folder`."""
    report = RunReport.model_validate(description)
    sections: list[Section] = [(f"{printable(report.title or folder.name)}: {folder}", facts.rows(report))]
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
