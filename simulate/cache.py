"""Stacks and models on disk: kept while what they were made from has not changed, made again when it has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest
from ommatid.runtime.processors import one_thread
from ommatid.runtime.progress import Progress
from ommatid.scenes import model_file, stack
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack

from . import calibrate, render
from .calibration.stopping_rule import StoppingRule
from .sampling.checkpoint import clear, open_checkpoint


def cached_stack(path: Path, setup: Setup, progress: Progress) -> tuple[Stack, bool]:
    """The stack at `path` as it is on disk, and whether it had to be rendered. Raises what rendering raises.

    Where there is a world, what it truly looks like is kept beside the stack.
    """
    truth = setup.image
    if setup.scene.world is not None:
        from .ground_truth import cached_truth

        truth = cached_truth(path.with_name(TRUTH), setup)
    try:
        old = stack.read(path)
    except InputError:  # missing, damaged or of another kind: to be made
        old = None
    if old is not None and old.record.get("fingerprint") == render.made_from(setup):
        now = setup.resolved
        record = {**old.record, "truth": digest(truth.astype(np.float32))}
        if old.scene.plain() != now.plain() or old.record != record:
            # What the estimator is told, or what it is compared with, may have changed; the values have not.
            stack.write(path, replace(old, scene=now, record=record))
        clear(path)
        return stack.read(path), False
    with open_checkpoint(path, render.made_from(setup)) as partial:
        stack.write(path, render.render(setup, progress, partial, truth))
    return stack.read(path), True


@one_thread()
def cached_model(path: Path, setup: Setup, progress: Progress, judge: StoppingRule | None = None) -> tuple[Model, bool]:
    """The model at `path` as it is on disk, and whether it had to be calibrated. Raises what calibration raises.

    judge : says when to stop where the scene leaves the number of samples open
    """
    wanted = calibrate.made_from(setup, judge)
    try:
        old = model_file.read(path)
    except InputError:
        old = None
    if old is not None and old.record.get("fingerprint") == wanted:
        clear(path)
        return old, False
    with open_checkpoint(path, wanted) as partial:
        model_file.write(path, calibrate.calibrate(setup, progress, partial, judge))
    return model_file.read(path), True
