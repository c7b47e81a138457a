"""Stacks and models on disk: kept while what they were made from has not changed, made again when it has."""

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
    """The stack at `path` as it is on disk, and whether it had to be rendered. Raises what rendering raises.

    Where there is a world, what it truly looks like is kept beside the stack.
    """
    truth = setup.image
    if setup.scene.world is not None:
        from .ground_truth import cached_truth

        truth = cached_truth(path.with_name(TRUTH), setup)
    wanted = render.made_from(setup)
    with open_checkpoint(path, wanted) as partial:
        current, made = cached(
            path,
            wanted,
            _read_stack,
            lambda: render.render(setup, progress, partial, truth),
            stack.write,
        )
    now = setup.resolved
    record = {**current.record, "truth": digest(truth.astype(np.float32))}
    if current.scene.plain() != now.plain() or current.record != record:
        # What the estimator assumes, or what it is compared with, may have changed; the values have not.
        stack.write(path, replace(current, scene=now, record=record))
        current = stack.read(path)
    return current, made


def _read_stack(path: Path) -> tuple[Stack, str | None]:
    found = stack.read(path)
    return found, found.record.get("fingerprint")


def _read_model(path: Path) -> tuple[Model, str | None]:
    found = model_file.read(path)
    return found, found.record.get("fingerprint")


@one_thread()
def cached_model(path: Path, setup: Setup, progress: Progress, judge: StoppingRule | None = None) -> tuple[Model, bool]:
    """The model at `path` as it is on disk, and whether it had to be calibrated. Raises what calibration raises.

    judge : says when to stop where the scene leaves the number of samples open
    """
    wanted = calibrate.made_from(setup, judge)
    with open_checkpoint(path, wanted) as partial:
        return cached(
            path,
            wanted,
            _read_model,
            lambda: calibrate.calibrate(setup, progress, partial, judge),
            model_file.write,
        )
