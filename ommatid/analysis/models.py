"""Several ideas of one camera's H, for a study: each is made only where it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from ommatid.runtime.progress import Progress
from ommatid.scenes.model import Model
from ommatid.scenes.setup import Setup
from ommatid.simulate.cache import cached_model
from ommatid.simulate.calibration.stopping_rule import StoppingRule
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix


def study_models(
    setup: Setup, folder: Path, progress: Progress, judge: StoppingRule | None = None
) -> dict[str, Callable[[], Model]]:
    """What makes each model that the scene's study names; calibrated ones are kept in `folder`."""
    names = () if setup.scene.study is None else setup.scene.study.models
    return {name: partial(_made, name, setup, folder, progress, judge) for name in names}


def _made(name: str, setup: Setup, folder: Path, progress: Progress, judge: StoppingRule | None) -> Model:
    scene, camera = setup.scene, setup.camera
    if name in ("points", "transport"):
        told = scene.calibration.model_copy(update={"method": name})
        alone = "model.npz" if name == scene.calibration.method else f"model.{name}.npz"
        changed = replace(setup, scene=scene.model_copy(update={"calibration": told}))
        return cached_model(folder / alone, changed, progress, judge)[0]
    if name == "true":
        return exact_model(setup.resolved, camera, true_matrix(camera), "true")
    return ideal_model(setup.resolved, camera)
