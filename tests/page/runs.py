"""Runs to draw pages of: a letter F that perfect lenses saw, and frames too large to be reconstructed in a test."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.page.data import Run, read_run
from ommatid.reconstruct.output import result_files, run_json
from ommatid.runtime.files import make_folder
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from ..examples import THREE, scene

RECORD: dict[str, Any] = {"seconds": 0.25, "versions": {}, "seed": 3, "first_seed": 5}


def letter() -> NDArray[np.bool_]:
    """An F, (24, 24): no turn or mirror leaves it as it is."""
    drawn = np.zeros((24, 24), dtype=bool)
    drawn[3:21, 5:9] = drawn[3:7, 5:19] = drawn[11:14, 5:15] = True
    return drawn


F = letter()


def seen(described: Scene, truth: NDArray[np.float64], dead: int = 0) -> tuple[Stack, Model]:
    """What perfect lenses record of a picture, with noise, and their H."""
    camera, model = derive(described), ideal_model(described, derive(described))
    model = replace(model, record={**model.record, "seconds": 0.5, "versions": {}})
    values = model.forward(truth) + np.random.default_rng(7).normal(0, 0.1, camera.measurements)
    values[: 11 * dead : 11] = np.nan
    return Stack(described, camera, values, np.zeros_like(values), RECORD), model


def lettered(folder: Path, *, dead: int = 0, truth: bool = True) -> Run:
    """The run of an F in `folder`, which holds what a page is drawn from."""
    three = [(magnification, array, "fit") for magnification, array, _ in THREE]
    picture = np.where(F, 220.0, 30.0)
    stack, model = seen(scene((24, 24), tuple(three), noise={"variance": 1e-2}), picture, dead)
    known = picture.ravel() if truth else None
    restoration, report = result_files.reconstruct(stack, model, known, (folder / "stack.exr", folder / "model.npz"))
    make_folder(folder)
    result_files.write_estimate(folder / result_files.ESTIMATE, restoration, {})
    run_json.write(folder, report.with_changes(fingerprint="f"))
    return read_run(folder, stack, model)


def synthetic(small: Run, shape: tuple[int, int]) -> Run:
    """A run that never was: noise on a gradient of any size, with the numbers of another run."""
    tables = scene(shape, tuple((m, array, "fit") for m, array, _ in THREE), noise={"variance": 1e-2}).plain()
    tables["camera"]["lens_pitch"] = "40 mm"
    truth = np.add.outer(np.linspace(0, 120, shape[0]), np.linspace(0, 120, shape[1]))
    stack, model = seen(parse(tables, Path("test.toml")), truth)
    noise = np.random.default_rng(8).normal(0, 1, shape)
    return replace(
        small,
        stack=stack,
        model=model,
        estimate=(truth + noise).astype(np.float32),
        variance=np.ones(shape, dtype=np.float32),
        truth=truth.astype(np.float32),
    )
