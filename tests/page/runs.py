"""Runs for the tests of pages: a letter F seen by ideal pinholes, and frames too large to reconstruct in a test."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.page.data import Run, read_run
from ommatid.reconstruct.output import result_files, run_json
from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.files import make_folder
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from ..examples import THREE, scene

RECORD: dict[str, Any] = {"seconds": 0.25, "versions": {}, "seed": 3, "first_seed": 5}
LENSES = tuple((magnification, array, "fit") for magnification, array, _ in THREE)


def letter() -> BoolArray:
    """An F, (24, 24), which no rotation or reflection maps to itself."""
    pixels = np.zeros((24, 24), dtype=bool)
    pixels[3:21, 5:9] = pixels[3:7, 5:19] = pixels[11:14, 5:15] = True
    return pixels


F = letter()


def record(described: Scene, image: FloatArray, dead: int = 0) -> tuple[Stack, Model]:
    """The stack of an image recorded by ideal lenses, with noise and dead pixels, and the ideal model."""
    camera, model = derive(described), ideal_model(described, derive(described))
    model = replace(model, record={**model.record, "seconds": 0.5, "versions": {}})
    values = model.forward(image) + np.random.default_rng(7).normal(0, 0.1, camera.measurements)
    values[: 11 * dead : 11] = np.nan
    return Stack(described, camera, values, np.zeros_like(values), RECORD), model


def letter_run(folder: Path, *, dead: int = 0, truth: bool = True) -> Run:
    """The run of an F, whose results are written to `folder`."""
    image = np.where(F, 220.0, 30.0)
    stack, model = record(scene((24, 24), LENSES, noise={"variance": 1e-2}), image, dead)
    names = folder / "stack.exr", folder / "model.npz"
    restoration, report = result_files.reconstruct(stack, model, image.ravel() if truth else None, names)
    make_folder(folder)
    result_files.write_estimate(folder / result_files.ESTIMATE, restoration, {})
    run_json.write(folder, report.with_changes(fingerprint="f"))
    return read_run(folder, None, stack, model)


def synthetic(small: Run, shape: tuple[int, int]) -> Run:
    """A run with unit noise on a gradient of any size as its estimate, and with the report of another run."""
    tables = scene(shape, LENSES, noise={"variance": 1e-2}).plain()
    tables["camera"]["lens_pitch"] = "40 mm"
    truth = np.add.outer(np.linspace(0, 120, shape[0]), np.linspace(0, 120, shape[1]))
    stack, model = record(parse(tables, Path("test.toml")), truth)
    noise = np.random.default_rng(8).normal(0, 1, shape)
    return replace(
        small,
        stack=stack,
        model=model,
        estimate=(truth + noise).astype(np.float32),
        variance=np.ones(shape, dtype=np.float32),
        truth=truth.astype(np.float32),
    )
