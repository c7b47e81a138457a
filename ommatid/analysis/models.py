"""The models of H that a study compares; each is made only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from ommatid.runtime.progress import Progress
from ommatid.scenes.model import Model
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import cached_model
from ommatid.simulate.calibration.adaptive_rounds import StoppingRule
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix


def study_models(
    setup: Setup, folder: Path, progress: Progress, stopping_rule: StoppingRule | None = None
) -> dict[str, Callable[[], Model]]:
    """Return by name the functions that make the models of a scene's study; calibrated ones are cached in `folder`."""

    scene, camera = setup.scene, setup.calibrated.camera

    def make(name: str) -> Model:
        if name == "true":
            return exact_model(setup.resolved, camera, true_matrix(camera), "true")
        if name not in ("points", "transport"):
            return ideal_model(setup.resolved, camera)
        calibration = scene.calibration.model_copy(update={"method": name})
        path = folder / ("model.npz" if name == scene.calibration.method else f"model.{name}.npz")
        changed = replace(setup, scene=scene.model_copy(update={"calibration": calibration}))
        return cached_model(path, changed, progress, stopping_rule)[0]

    return {name: partial(make, name) for name in (() if scene.study is None else scene.study.models)}
