"""The results of commands that write no file: a scene's plan, its prediction, candidate lens types, the backends."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from ommatid.analysis import design, summary
from ommatid.analysis.design import DesignCandidate
from ommatid.analysis.predict import electrons, optics, predict_ideal, predict_scene
from ommatid.analysis.prediction_table import json_of
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.renderer import variant
from ommatid.simulate.world_view import check_world


@dataclass(frozen=True)
class DesignComparison:
    """The expected error of a scene, and the candidates ranked by the expected error with each."""

    before: Prediction
    candidates: list[DesignCandidate]

    def describe(self) -> dict[str, Any]:
        """Describe the comparison in JSON's types."""
        return {"before": json_of(self.before), "candidates": [candidate.describe() for candidate in self.candidates]}

    def rows(self) -> list[tuple[str, str]]:
        """Tabulate magnification, expected error, and the factor by which it falls."""
        return design.rows(self.before, self.candidates)


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Describe the geometry and the plan of a scene in JSON's types. Raises InputError that names the scene file."""
    setup = Setup.from_scene(scene)
    choice = choose_method(scene, setup.camera, setup.is_applied)
    with naming_source(scene.source):
        lens_optics, light = optics(setup.camera), electrons(setup)
        world = {} if scene.world is None else {"world": check_world(setup).describe()}
    return summary.describe(setup, variant.choose(scene.render.variant), choice, lens_optics, light) | world


def predict_with_light(scene: Scene, rays: bool = True) -> tuple[Prediction, dict[str, Any] | None]:
    """Predict the error of a scene and the electrons that its pixels collect, None without a sensor.

    rays : False for the ideal H in closed form alone
    Raises InputError that names the scene file.
    """
    with naming_source(scene.source):
        return predict_scene(scene, rays), electrons(Setup.from_scene(scene))


def describe_prediction(prediction: Prediction, light: dict[str, Any] | None) -> dict[str, Any]:
    """Describe a prediction in JSON's types."""
    return json_of(prediction) | ({} if light is None else {"light": light})


def compare_lens_types(
    scene: Scene, magnifications: Sequence[Fraction], progress: Progress = no_progress
) -> DesignComparison:
    """Predict the error of the scene with one more lens type of each magnification, with the ideal H."""
    before, of_pixels = predict_ideal(scene), Setup.from_scene(scene).camera.covers_whole_pixels
    candidates: list[DesignCandidate] = []
    for index, magnification in enumerate(magnifications):
        try:
            wider = design.with_lens(scene, magnification)
            if of_pixels:
                design.check_detail(wider)
            expected = predict_ideal(wider)
            candidates.append(DesignCandidate(str(magnification), expected))
        except InputError as error:
            reason = str(error).removeprefix(f"{scene.source}: ")
            candidates.append(DesignCandidate(str(magnification), None, reason))
        progress((index + 1) / len(magnifications))
    return DesignComparison(before, design.ranked(candidates))


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
