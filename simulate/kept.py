"""Stacks and models on disk: kept while what they were made from has not changed, made again when it has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenes import model, stack
from scenes.camera import Camera
from scenes.errors import InputError
from scenes.files import digest
from scenes.model import Judge, Model
from scenes.partial import clear, partial_of
from scenes.processors import one_thread
from scenes.progress import Progress
from scenes.scene import TRUTH, Scene, resolved
from scenes.stack import Stack

from . import calibrate, render


def kept_stack(
    path: Path, scene: Scene, camera: Camera, image: NDArray[np.float64], progress: Progress
) -> tuple[Stack, bool]:
    """The stack at `path` as it is on disk, and whether it had to be rendered. Raises what rendering raises.

    Where there is a world, what it truly looks like is kept beside the stack.
    """
    truth = image
    if scene.world is not None:
        from .truth import kept_truth

        truth = kept_truth(path.with_name(TRUTH), scene, camera, image)
    try:
        old = stack.read(path)
    except InputError:  # missing, damaged or of another kind: to be made
        old = None
    if old is not None and old.record.get("fingerprint") == render.made_from(scene, camera, image):
        now = resolved(scene, (camera.rows, camera.columns))
        record = {**old.record, "truth": digest(truth.astype(np.float32))}
        if old.scene.plain() != now.plain() or old.record != record:
            # What the estimator is told, or what it is compared with, may have changed; the values have not.
            stack.write(path, replace(old, scene=now, record=record))
        clear(path)
        return stack.read(path), False
    with partial_of(path, render.made_from(scene, camera, image)) as partial:
        stack.write(path, render.render(scene, camera, image, progress, partial, truth))
    return stack.read(path), True


@one_thread()
def kept_model(
    path: Path, scene: Scene, camera: Camera, progress: Progress, judge: Judge | None = None
) -> tuple[Model, bool]:
    """The model at `path` as it is on disk, and whether it had to be calibrated. Raises what calibration raises.

    judge : says when to stop where the scene leaves the number of samples open
    """
    wanted = calibrate.made_from(scene, camera, judge)
    try:
        old = model.read(path)
    except InputError:
        old = None
    if old is not None and old.record.get("fingerprint") == wanted:
        clear(path)
        return old, False
    with partial_of(path, wanted) as partial:
        model.write(path, calibrate.calibrate(scene, camera, progress, partial, judge))
    return model.read(path), True
