"""Several ideas of one camera's H, for a study: each is made only where it is asked for."""

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
    scene: Scene, camera: Camera, folder: Path, progress: Progress, judge: StoppingRule | None = None
) -> dict[str, Callable[[], Model]]:
    """What makes each model that the scene's study names; calibrated ones are kept in `folder`."""
    names = () if scene.study is None else scene.study.models
    return {name: partial(_made, name, scene, camera, folder, progress, judge) for name in names}


def _made(
    name: str, scene: Scene, camera: Camera, folder: Path, progress: Progress, judge: StoppingRule | None
) -> Model:
    kept = resolved(scene, camera.shape)
    if name in ("points", "transport"):
        told = scene.calibration.model_copy(update={"method": name})
        alone = "model.npz" if name == scene.calibration.method else f"model.{name}.npz"
        return cached_model(folder / alone, scene.model_copy(update={"calibration": told}), camera, progress, judge)[0]
    return exact_model(kept, camera, true_matrix(camera), "true") if name == "true" else ideal_model(kept, camera)
