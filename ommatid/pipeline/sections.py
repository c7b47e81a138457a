"""The tables that commands print of each result, and the results of those that write no file: a plan, the backends."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ommatid.analysis import depth_error, predict, prediction_table, study, summary
from ommatid.analysis.predict import electrons, optics
from ommatid.analysis.summary import Section
from ommatid.batch.batch import Member
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.output import facts
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.runtime.errors import naming_source
from ommatid.runtime.printable import printable
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import ThroughFocus
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate import world_view
from ommatid.simulate.renderer import variant

from .batches import BatchOutcome


def run_sections(folder: Path, report: RunReport) -> list[Section]:
    """Tabulate the results of a finished run in `folder`."""
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


def predicted_sections(members: Sequence[Member], outcome: BatchOutcome, detail: str | None) -> list[Section]:
    """Tabulate predictions: that of one scene, several beside each other, or a sweep; for `detail` "table" each.

    Scenes that failed are left out.
    """
    pairs = [pair for pair in zip(members, outcome.documents, strict=True) if "error" not in pair[1]]
    if detail == "table" or (len(members) == 1 and detail != "verdict"):
        each = [section for member, document in pairs for section in _prediction_sections(member.content, document)]
        return [*each, *outcome.sections]
    if detail == "verdict" or outcome.sections or not pairs:
        return outcome.sections if detail == "summary" else []
    names = [Path(document["scene"]).stem for _, document in pairs]
    compared = prediction_table.rows([document for _, document in pairs])
    return [("Expected errors (Eq. 5)", [("scene", *names), *compared])]


def predicted_lines(documents: Iterable[dict[str, Any]]) -> list[str]:
    """Return a line for each prediction: the scene, its swept values, and the expected error."""
    lines: list[str] = []
    for document in documents:
        if "error" not in document:
            values = "".join(f", {key} = {value}" for key, value in document.get("values", {}).items())
            error = error_words(document["mse"], prediction_table.DIGITS)
            lines.append(f"{Path(document['scene']).stem}{values}: expected squared error {error}")
    return lines


def _prediction_sections(scene: Scene, document: dict[str, Any]) -> list[Section]:
    """Tabulate a prediction, and the electrons that the pixels collect where the scene has a sensor."""
    lines = prediction_table.rows([document])
    if (
        any(sentence.startswith(predict.LEFT_OUT) for sentence in document["assumes"])
        and scene.camera.tolerance is not None
        and "misalignment" not in document
        and scene.estimator.misalignment == "trust"
    ):
        lines.append(("misalignment", "not included; it is predicted for small targets and sharp lenses only"))
    return [(printable(scene.title or scene.source.stem), lines), *_light_sections(document)]


def backend_sections(description: dict[str, Any]) -> list[Section]:
    """Tabulate the rendering backends and the versions of the libraries."""
    backends = [
        (backend["variant"], backend["reason"] or f"works, {backend['samples_per_second'] / 1e6:.0f} million samples/s")
        for backend in description["backends"]
    ]
    return [("Backends", backends), ("Versions", list(description["versions"].items()))]


def _light_sections(description: dict[str, Any]) -> list[Section]:
    return [("Electrons", summary.light_rows(description["light"]))] if "light" in description else []


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Describe the geometry and the plan of a scene in JSON's types. Raises InputError that names the scene file."""
    setup = Setup.from_scene(scene)
    choice = choose_method(scene, setup.camera, setup.is_applied)
    with naming_source(scene.source):
        lens_optics, light = optics(setup.camera), electrons(setup)
        world = {} if scene.world is None else {"world": world_view.check_world(setup).describe()}
    return summary.describe(setup, variant.choose(scene.render.variant), choice, lens_optics, light) | world


def focus_curves(scene: Scene) -> list[ThroughFocus]:
    """Return the contrast of lens types through focus. Raises InputError that names the scene file."""
    camera = derive(scene)
    if not camera.has_width:
        return []
    from ommatid.scenes.optics.sharpness import through_focus

    with naming_source(scene.source):
        return through_focus(camera)


def describe_backends() -> dict[str, Any]:
    """Render a small image on each backend in a separate process, and describe the backends in JSON's types."""
    probes = [variant.probe(name) for name in variant.PREFERENCE]
    backends = [
        {"variant": status.variant, "reason": status.reason, "samples_per_second": status.speed} for status in probes
    ]
    return {
        "backends": backends,
        "advice": variant.diagnosis(probes),
        "versions": versions("mitsuba", "drjit", "OpenEXR", "scipy", "scikit-image"),
        "cores": os.cpu_count(),
    }
