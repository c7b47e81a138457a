"""Stacks and models on disk, reused while their fingerprint matches the scene and made again otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ommatid.runtime.files import cached, digest
from ommatid.runtime.processors import one_thread
from ommatid.runtime.progress import Progress
from ommatid.scenes import model_file, stack
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack

from . import calibrate, render
from .calibration.stopping_rule import StoppingRule
from .sampling.checkpoint import open_checkpoint


def cached_stack(path: Path, setup: Setup, progress: Progress) -> tuple[Stack, bool]:
    """Return the stack at `path` as it is on disk, and True if it had to be rendered.

    The truth of a world is stored beside the stack. Raises what `render` raises.
    """
    truth = setup.image
    if setup.scene.world is not None:
        from .ground_truth import cached_truth

        truth = cached_truth(path.with_name(TRUTH), setup)
    made_from = render.made_from(setup)
    with open_checkpoint(path, made_from) as checkpoint:
        result, made = cached(
            path, made_from, _read_stack, lambda: render.render(setup, progress, checkpoint, truth), stack.write
        )
    record = {**result.record, "truth": digest(truth.astype(np.float32))}
    if result.scene.plain() != setup.resolved.plain() or result.record != record:
        # The estimator's tables or the truth may have changed; the values have not.
        stack.write(path, replace(result, scene=setup.resolved, record=record))
        result = stack.read(path)
    return result, made


def _read_stack(path: Path) -> tuple[Stack, str | None]:
    result = stack.read(path)
    return result, result.record.get("fingerprint")


@one_thread()
def cached_model(
    path: Path, setup: Setup, progress: Progress, stopping_rule: StoppingRule | None = None
) -> tuple[Model, bool]:
    """Return the model at `path` as it is on disk, and True if it had to be calibrated.

    stopping_rule : needed where the scene leaves the number of samples open
    Raises what `calibrate` raises.
    """
    made_from = calibrate.made_from(setup, stopping_rule)
    with open_checkpoint(path, made_from) as checkpoint:
        return cached(
            path,
            made_from,
            _read_model,
            lambda: calibrate.calibrate(setup, progress, checkpoint, stopping_rule),
            model_file.write,
        )


def _read_model(path: Path) -> tuple[Model, str | None]:
    model = model_file.read(path)
    return model, model.record.get("fingerprint")
