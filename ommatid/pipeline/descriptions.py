"""The results of commands that write no file: a scene's plan, candidate lens types, the backends."""

from __future__ import annotations

import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.analysis import best_camera, summary
from ommatid.analysis.design import DesignCandidate, DesignComparison, LensCandidate, check_detail, with_lens
from ommatid.analysis.predict import electrons, optics, predict_scene
from ommatid.reconstruct.method_choice import choose_method
from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import make_folder
from ommatid.runtime.progress import Progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import ThroughFocus
from ommatid.scenes.scene import Scene, write
from ommatid.scenes.setup import Setup
from ommatid.simulate.renderer import variant
from ommatid.simulate.world_view import check_world

Rows = list[tuple[str, str]]


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Describe the geometry and the plan of a scene in JSON's types. Raises InputError that names the scene file."""
    setup = Setup.from_scene(scene)
    choice = choose_method(scene, setup.camera, setup.is_applied)
    with naming_source(scene.source):
        lens_optics, light = optics(setup.camera), electrons(setup)
        world = {} if scene.world is None else {"world": check_world(setup).describe()}
    return summary.describe(setup, variant.choose(scene.render.variant), choice, lens_optics, light) | world


def focus_curves(scene: Scene) -> list[ThroughFocus]:
    """Return the contrast of lens types through focus. Raises InputError that names the scene file."""
    camera = derive(scene)
    if not camera.has_width:
        return []
    from ommatid.simulate.lenses.sharpness import through_focus

    with naming_source(scene.source):
        return through_focus(camera)


def compare_lens_types(scene: Scene, magnifications: Sequence[Fraction], progress: Progress) -> DesignComparison:
    """Predict the error of the scene with one more lens type of each magnification, with the ideal H."""
    before = predict_scene(scene, rays=False)
    candidates: list[DesignCandidate] = []
    for index, magnification in enumerate(magnifications):
        try:
            wider = with_lens(scene, magnification)
            check_detail(scene, wider)
            candidates.append(DesignCandidate(str(magnification), predict_scene(wider, rays=False)))
        except InputError as error:
            reason = str(error).removeprefix(f"{scene.source}: ")
            candidates.append(DesignCandidate(str(magnification), None, reason))
        progress((index + 1) / len(magnifications))
    candidates.sort(key=lambda candidate: np.inf if candidate.expected is None else candidate.expected.mse)
    return DesignComparison(before, candidates)


def prove_best_camera(
    scene: Scene, wanted: Sequence[LensCandidate], folder: Path | None, progress: Progress
) -> tuple[dict[str, Any], Rows]:
    """Choose the best camera of some lens types, and return the proof in JSON's types and as rows of a table.

    folder : of the scene files of the best cameras of whole arrays, None to write none
    Raises InputError where no bound is known.
    """
    best = best_camera.best_camera(scene, wanted)
    with_edges = list[float | str]()
    for number, camera in enumerate(best.whole, 1):
        types = [each for each, count in zip(best.types, camera.counts, strict=True) for _ in range(count)]
        try:
            made = best_camera.scene_of(scene, types)
            with_edges.append(predict_scene(made, rays=False).mse)
            if folder is not None:
                make_folder(folder)
                write(folder / f"camera{number}.toml", made)
        except InputError as error:
            with_edges.append(str(error).removeprefix(f"{scene.source}: "))
        progress(number / len(best.whole))
    return best_camera.describe(best, with_edges), best_camera.rows(best, with_edges)


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
