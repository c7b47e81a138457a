"""Stacks and models on disk, reused while their fingerprint matches the scene and made again otherwise."""

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
    """Return the stack at `path` as it is on disk, and True if it had to be rendered.

    The ground truth of a world is stored beside the stack. Raises what `render` raises.
    """
    truth = setup.image
    if setup.scene.world is not None:
        from .ground_truth import cached_truth

        truth = cached_truth(path.with_name(TRUTH), setup)
    try:
        old = stack.read(path)
    except InputError:  # missing, damaged or of another format
        old = None
    made_from = render.made_from(setup)
    if old is not None and old.record.get("fingerprint") == made_from:
        record = {**old.record, "truth": digest(truth.astype(np.float32))}
        if old.scene.plain() != setup.resolved.plain() or old.record != record:
            # The estimator's tables or the ground truth may have changed; the values have not.
            stack.write(path, replace(old, scene=setup.resolved, record=record))
        clear(path)
        return stack.read(path), False
    with open_checkpoint(path, made_from) as checkpoint:
        stack.write(path, render.render(setup, progress, checkpoint, truth))
    return stack.read(path), True


@one_thread()
def cached_model(
    path: Path, setup: Setup, progress: Progress, stopping_rule: StoppingRule | None = None
) -> tuple[Model, bool]:
    """Return the model at `path` as it is on disk, and True if it had to be calibrated.

    stopping_rule : needed where the scene leaves the number of samples open
    Raises what `calibrate` raises.
    """
    made_from = calibrate.made_from(setup, stopping_rule)
    try:
        old = model_file.read(path)
    except InputError:
        old = None
    if old is not None and old.record.get("fingerprint") == made_from:
        clear(path)
        return old, False
    with open_checkpoint(path, made_from) as checkpoint:
        model_file.write(path, calibrate.calibrate(setup, progress, checkpoint, stopping_rule))
    return model_file.read(path), True
