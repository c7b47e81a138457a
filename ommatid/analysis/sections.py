"""The tables that commands print: which there are of each result, in their order.

A section is a title and rows of a name and a value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ommatid.batch.batch import Member
from ommatid.reconstruct import prediction as predictions
from ommatid.reconstruct.prediction import Prediction
from ommatid.scenes.optics import radiometry
from ommatid.scenes.scene import Scene
from ommatid.simulate.lenses import sharpness

from . import depth_error, run_table, study, summary

Section = tuple[str, list[tuple[str, str]]]


def run_sections(member: Member, description: dict[str, Any]) -> list[Section]:
    """Tabulate the description of a finished run."""
    sections = [(f"{description['title'] or member.scene.stem}: {member.folder}", run_table.rows(description))]
    if "depth" in description:
        sections.append(("Error against distance", depth_error.rows(description["depth"])))
    if "study" in description:
        sections.append(("The same stack with other models of H", study.rows(description["study"])))
    return sections


def scene_sections(description: dict[str, Any]) -> list[Section]:
    """Tabulate the description of a scene: geometry, optics, electrons, plan, skipped effects."""
    geometry, *others = summary.sections(description)
    return [geometry, *_optics_sections(description.get("optics", ())), *_light_sections(description), *others]


def prediction_sections(scene: Scene, prediction: Prediction, light: dict[str, Any] | None) -> list[Section]:
    """Tabulate a prediction, and the electrons that the pixels collect where the scene has a sensor."""
    lines, tolerance = predictions.rows(prediction), scene.camera.tolerance
    if tolerance is not None and prediction.misalignment is None and scene.estimator.misalignment == "trust":
        lines.append(("misalignment", "not included; it is predicted for small targets and sharp lenses only"))
    return [(scene.title or scene.source.stem, lines), *_light_sections({"light": light} if light else {})]


def _optics_sections(optics: Sequence[dict[str, Any]]) -> list[Section]:
    return [("Optics", [(f"lens type {lens['lens']}", sharpness.words(lens)) for lens in optics])] if optics else []


def _light_sections(description: dict[str, Any]) -> list[Section]:
    return [("Electrons", radiometry.rows(description["light"]))] if "light" in description else []
