"""H with the uncertainty of its every entry, from rendered point sources or in closed form."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

from ommatid.runtime.files import fingerprint
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.optics.negligible import without_negligible_effects
from ommatid.scenes.scene import Scene, resolved

from .calibration.entries import rendered_model
from .calibration.stopping_rule import StoppingRule
from .ideal import ideal_model
from .sampling.checkpoint import Checkpoint


def made_from(scene: Scene, camera: Camera, judge: StoppingRule | None = None) -> str:
    """Fingerprint of everything that H depends on; `judge` where it says when to stop."""
    description: dict[str, Any] = {"camera": camera.describe(), "calibration": scene.calibration.model_dump()}
    if judge is not None and is_adaptive(scene):
        description["judged"] = judge.fingerprint
    if scene.calibration.method != "ideal":
        description["simulated"] = without_negligible_effects(scene, camera)[0].describe()
        description["versions"] = versions("mitsuba")
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(
    scene: Scene,
    camera: Camera,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
    judge: StoppingRule | None = None,
) -> Model:
    """H as the scene's `calibration.method` finds it, with the variance of every entry and its record.

    judge : says when to stop where the scene leaves the number of samples open
    Raises InputError if the variant asked for does not work here, DeniedError if a row fails its check.
    """
    start = perf_counter()
    record: dict[str, Any] = {"fingerprint": made_from(scene, camera, judge), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(resolved(scene, camera.shape), camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    if is_adaptive(scene):
        from .calibration.adaptive_rounds import calibrate_until

        model = calibrate_until(scene, camera, judge, progress, partial)
        return replace(model, record=model.record | record | {"seconds": perf_counter() - start})
    model = rendered_model(scene, camera, progress, partial)
    return replace(model, record=record | model.record)


def is_adaptive(scene: Scene) -> bool:
    """Whether the number of samples is left open."""
    return scene.calibration.samples == "auto" and scene.calibration.method != "ideal"
