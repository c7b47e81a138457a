"""The models of H that a study compares; each is made only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from ommatid.runtime.progress import Progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene, resolved
from ommatid.simulate.cache import cached_model
from ommatid.simulate.calibration.stopping_rule import StoppingRule
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix


def study_models(
    scene: Scene, camera: Camera, folder: Path, progress: Progress, stopping_rule: StoppingRule | None = None
) -> dict[str, Callable[[], Model]]:
    """Return by name the functions that make the models of a scene's study; calibrated ones are cached in `folder`."""

    def make(name: str) -> Model:
        as_run = resolved(scene, camera.shape)
        if name == "true":
            return exact_model(as_run, camera, true_matrix(camera), "true")
        if name not in ("points", "transport"):
            return ideal_model(as_run, camera)
        calibration = scene.calibration.model_copy(update={"method": name})
        path = folder / ("model.npz" if name == scene.calibration.method else f"model.{name}.npz")
        described = scene.model_copy(update={"calibration": calibration})
        return cached_model(path, described, camera, progress, stopping_rule)[0]

    return {name: partial(make, name) for name in (() if scene.study is None else scene.study.models)}
