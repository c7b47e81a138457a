"""What a page is drawn from: the files in a run's folder, and maps reduced to what a page holds.

Maps are (rows, columns) in the target's pixels, row 0 at the top; values are in the target's units, 0 to 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.result_files import ESTIMATE
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes import model_file, stack
from ommatid.scenes.formats import exr
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

Image = NDArray[np.float32]

MOST_PIXELS = 2**16  # of a map on a page: three of them as float32 are a megabyte of text


@dataclass(frozen=True)
class Run:
    """A finished run: what run.json says, what was recorded, the model, and estimate.exr's maps; truth may be None."""

    folder: Path
    description: RunReport
    stack: Stack
    model: Model
    estimate: Image
    variance: Image
    truth: Image | None

    @property
    def title(self) -> str:
        """What the scene is called, or its folder where it has no title."""
        return self.stack.scene.title or self.folder.resolve().name


@dataclass(frozen=True)
class ResultMaps:
    """What is shown of a run: means over blocks of `block` x `block` pixels, as they are where it is 1.

    deviation : posterior standard deviation of a single pixel, the root of the blocks' mean variance
    """

    rows: int
    columns: int
    block: int
    estimate: Image
    deviation: Image
    truth: Image | None

    @property
    def error(self) -> Image | None:
        """Estimate minus truth."""
        return None if self.truth is None else self.estimate - self.truth


def read_run(folder: Path, recorded: Stack | None = None, calibrated: Model | None = None) -> Run:
    """The run in a folder; stack and model are read only where they are not given. Raises InputError."""
    channels = exr.read(folder / ESTIMATE)[0].channels
    return Run(
        folder=folder,
        description=run_json.read(folder),
        stack=stack.read(folder / "stack.exr") if recorded is None else recorded,
        model=model_file.read(folder / "model.npz") if calibrated is None else calibrated,
        estimate=channels["estimate"],
        variance=channels["variance"],
        truth=channels.get("truth"),
    )


def maps(run: Run) -> ResultMaps:
    """The maps of a run, reduced so that a page holds them."""
    rows, columns = run.estimate.shape
    block = block_for(rows * columns, MOST_PIXELS)
    return ResultMaps(
        rows=rows,
        columns=columns,
        block=block,
        estimate=reduced(run.estimate, block),
        deviation=np.sqrt(reduced(run.variance, block)),
        truth=None if run.truth is None else reduced(run.truth, block),
    )


def block_for(pixels: int, most: int) -> int:
    """Side of the blocks whose means are no more than `most`, but for those at the edges."""
    return max(1, ceil(sqrt(pixels / most)))


def reduced(image: NDArray[Any], block: int) -> Image:
    """Means over blocks of `block` x `block` pixels, smaller at the lower and right edge, without what is NaN there.

    NaN where nothing else is. A block of 1 leaves the image as it is.
    """
    if block == 1:
        return np.asarray(image, dtype=np.float32)
    known = np.isfinite(image)
    sums = _sums(np.where(known, image, 0.0), block)
    counts = _sums(known.astype(np.float64), block)
    means = np.full(sums.shape, np.nan)
    np.divide(sums, counts, out=means, where=counts > 0)
    return means.astype(np.float32)


def _sums(image: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    starts: list[NDArray[np.int64]] = [np.arange(0, size, block, dtype=np.int64) for size in image.shape]
    down = np.add.reduceat(image.astype(np.float64), starts[0], axis=0)
    return np.add.reduceat(down, starts[1], axis=1)
