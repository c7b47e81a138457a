"""H with the variance of each of its entries, from point sources, from rays or in closed form; reused from its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from ommatid.runtime.files import cached, fingerprint
from ommatid.runtime.machine import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes import model_file
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

from .calibration.adaptive_rounds import StoppingRule, calibrate_until
from .calibration.entries import rendered_model
from .ideal import ideal_model
from .sampling.checkpoint import Checkpoint, open_checkpoint


def made_from(setup: Setup, stopping_rule: StoppingRule | None = None) -> str:
    """Return the fingerprint of everything that H depends on."""
    setup = setup.calibrated
    scene = setup.scene
    description: dict[str, Any] = {"camera": setup.camera.describe(), "calibration": scene.calibration.model_dump()}
    if stopping_rule is not None and is_adaptive(scene):
        description["judged"] = stopping_rule.fingerprint
    if scene.calibration.method != "ideal":
        description["simulated"] = setup.simulated.describe()
        description["versions"] = versions("mitsuba")
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    stopping_rule: StoppingRule | None = None,
) -> Model:
    """Determine H by the scene's `calibration.method`, with the variance of every entry and a record.

    stopping_rule : needed where the scene leaves the number of samples open
    Raises InputError if the requested variant does not work here, MachineError if a row fails its check.
    """
    setup, start = setup.calibrated, perf_counter()
    scene = setup.scene
    record: dict[str, Any] = {"fingerprint": made_from(setup, stopping_rule), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(setup.resolved, setup.camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    if is_adaptive(scene):
        model = calibrate_until(setup, stopping_rule, progress, checkpoint)
        return replace(model, record=model.record | record | {"seconds": perf_counter() - start})
    model = rendered_model(setup, progress, checkpoint)
    return replace(model, record=record | model.record)


def is_adaptive(scene: Scene) -> bool:
    """Return True if the scene leaves the number of samples of its calibration open."""
    return scene.calibration.samples == "auto" and scene.calibration.method != "ideal"


@one_thread()
def cached_model(
    path: Path, setup: Setup, progress: Progress, stopping_rule: StoppingRule | None = None
) -> tuple[Model, bool]:
    """Return the model at `path` as it is on disk, and True if it had to be calibrated.

    stopping_rule : needed where the scene leaves the number of samples open
    Raises what `calibrate` raises.
    """
    wanted = made_from(setup, stopping_rule)
    with open_checkpoint(path, wanted) as checkpoint:
        return cached(
            path,
            wanted,
            _read_model,
            lambda: calibrate(setup, progress, checkpoint, stopping_rule),
            model_file.write,
        )


def _read_model(path: Path) -> tuple[Model, str | None]:
    model = model_file.read(path)
    return model, model.record.get("fingerprint")
