"""H with the uncertainty of its every entry, from rendered point sources or in closed form."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

from ommatid.runtime.files import fingerprint
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

from .calibration.entries import rendered_model
from .calibration.stopping_rule import StoppingRule
from .ideal import ideal_model
from .sampling.checkpoint import Checkpoint


def made_from(setup: Setup, judge: StoppingRule | None = None) -> str:
    """Fingerprint of everything that H depends on; `judge` where it says when to stop."""
    scene = setup.scene
    description: dict[str, Any] = {"camera": setup.camera.describe(), "calibration": scene.calibration.model_dump()}
    if judge is not None and is_adaptive(scene):
        description["judged"] = judge.fingerprint
    if scene.calibration.method != "ideal":
        description["simulated"] = setup.simulated.describe()
        description["versions"] = versions("mitsuba")
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(
    setup: Setup,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
    judge: StoppingRule | None = None,
) -> Model:
    """H as the scene's `calibration.method` finds it, with the variance of every entry and its record.

    judge : says when to stop where the scene leaves the number of samples open
    Raises InputError if the variant asked for does not work here, DeniedError if a row fails its check.
    """
    scene, start = setup.scene, perf_counter()
    record: dict[str, Any] = {"fingerprint": made_from(setup, judge), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(setup.resolved, setup.camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    if is_adaptive(scene):
        from .calibration.adaptive_rounds import calibrate_until

        model = calibrate_until(setup, judge, progress, partial)
        return replace(model, record=model.record | record | {"seconds": perf_counter() - start})
    model = rendered_model(setup, progress, partial)
    return replace(model, record=record | model.record)


def is_adaptive(scene: Scene) -> bool:
    """Whether the number of samples is left open."""
    return scene.calibration.samples == "auto" and scene.calibration.method != "ideal"
