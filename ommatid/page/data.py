"""Input of a page: the files in a run's folder, maps reduced to a size that a page can hold, and one sub-image.

Maps are (rows, columns) in the target's pixels, row 0 at the top; values are in the target's units, 0 to 255.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.analysis.baselines import known_baselines
from ommatid.reconstruct.measured_error import enlarged
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.overview import sub_image_of
from ommatid.reconstruct.output.result_files import ESTIMATE, read_estimate
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import real_path
from ommatid.runtime.printable import printable
from ommatid.scenes import model_file, stack
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

MOST_PIXELS = 2**16  # of a map on a page: three such maps as float32 are a megabyte of text
MOST_MAPS = 4  # of so many pixels; more maps are smaller


@dataclass(frozen=True)
class Run:
    """A finished run: run.json, the stack, the model, and the maps of estimate.exr; `truth` is None if not known.

    others : images of the baselines by method, (rows, columns)
    """

    folder: Path
    report: RunReport
    stack: Stack
    model: Model
    estimate: Float32Array
    variance: Float32Array
    truth: Float32Array | None
    others: Mapping[str, Float32Array] = field(default_factory=dict[str, Float32Array])

    @property
    def title(self) -> str:
        """Title of the scene, or the name of the folder if it has none."""
        return printable(self.stack.scene.title or real_path(self.folder).name)


@dataclass(frozen=True)
class PageTable:
    """A caption, the column headers, and rows whose first cell is the row header."""

    caption: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def read_run(
    folder: Path, report: RunReport | None = None, recorded: Stack | None = None, calibrated: Model | None = None
) -> Run:
    """Read the run in a folder: its maps, and what of it is not given. Raises InputError."""
    channels = read_estimate(folder / ESTIMATE).channels
    report = run_json.read(folder) if report is None else report
    recorded = stack.read(folder / "stack.exr") if recorded is None else recorded
    shapes = {name: channels[name].shape for name in ("estimate", "variance") if name in channels}
    if shapes != dict.fromkeys(("estimate", "variance"), recorded.camera.shape):
        raise InputError(
            f"{folder / ESTIMATE}: expected the estimate and its variance of {recorded.camera.shape} pixels, got"
            f" {shapes or ', '.join(channels)}; run the scene again"
        )
    return Run(
        folder=folder,
        report=report,
        stack=recorded,
        model=model_file.read(folder / "model.npz") if calibrated is None else calibrated,
        estimate=channels["estimate"],
        variance=channels["variance"],
        truth=channels.get("truth"),
        others=_others(folder, report),
    )


def _others(folder: Path, report: RunReport) -> Mapping[str, Float32Array]:
    """Return the images of the baselines beside the single sub-image, which the page draws in any case."""
    known = known_baselines(folder, report.fingerprint) if len(report.baselines) > 1 else None
    return {} if known is None else {name: image for name, image in known.images.items() if name != "single"}


def maps_of(run: Run, block: int, single: FloatArray | None = None) -> dict[str, Float32Array]:
    """Return the maps of a run by name, as means over blocks of `block` x `block` pixels, images of other methods last.

    `deviation` is the posterior standard deviation of a pixel, the square root of the mean variance in a block.

    single : a sub-image on the grid of the image, None to leave it out
    """
    found = {"truth": run.truth, "single": single, "estimate": run.estimate}
    found["error"] = None if run.truth is None else run.estimate - run.truth
    reduced_maps = {name: reduced(image, block) for name, image in found.items() if image is not None}
    others = {name: reduced(image, block) for name, image in run.others.items()}
    return {**reduced_maps, "deviation": np.sqrt(reduced(run.variance, block)), **others}


def block_of(shape: tuple[int, ...], maps: int) -> int:
    """Return the side of the blocks whose means a page of so many maps of (rows, columns) shows.

    There are at most MOST_PIXELS blocks, and a few more with partial blocks at the edges.
    """
    most = MOST_PIXELS * MOST_MAPS / max(maps, MOST_MAPS)
    return max(1, ceil(sqrt(shape[0] * shape[1] / most)))


def reduced(image: NDArray[Any], block: int) -> Float32Array:
    """Return means over blocks of `block` x `block` pixels, without NaN; the last blocks may be smaller.

    Blocks with nothing but NaN are NaN.
    """
    if block == 1:
        return np.asarray(image, dtype=np.float32)
    known = np.isfinite(image)
    sums = _block_sums(np.where(known, image, 0.0), block)
    counts = _block_sums(known.astype(np.float64), block)
    means = np.full(sums.shape, np.nan)
    np.divide(sums, counts, out=means, where=counts > 0)
    return means.astype(np.float32)


def _block_sums(image: FloatArray, block: int) -> FloatArray:
    rows, columns = (np.arange(0, size, block, dtype=np.int64) for size in image.shape)
    return np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows, axis=0), columns, axis=1)


@dataclass(frozen=True)
class ShownSubImage:
    """A sub-image on f's grid, (rows, columns), its name, and whether it is the one of least error."""

    name: str
    image: FloatArray
    is_best: bool

    @property
    def title(self) -> str:
        """The title of its map."""
        return f"{'Best single' if self.is_best else 'Single'} sub-image ({self.name}, bicubic)"


def shown_sub_image(run: Run) -> ShownSubImage:
    """Return the best sub-image, or without the truth the central one of the type with the finest pixels."""
    camera, best = run.stack.camera, run.report.single
    sub, pixels = sub_image_of(run.stack, best and best.sub_imager)
    return ShownSubImage(sub.name, enlarged(camera, sub, pixels, np.arange(float(camera.rows))), best is not None)
