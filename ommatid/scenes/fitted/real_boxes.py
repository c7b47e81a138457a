"""H of box footprints whose views are displaced and magnified by any amount, applied without being stored."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..camera import Camera
from ..lens_type import LensType, SubImager
from ..optics.boxes import Box, BoxAxis, BoxFootprints, designed_box
from .view import COLUMN, MAGNIFICATION, ROW


def real_overlap(ratio: float, pixels: int, start: float, size: int) -> sparse.csr_array:
    """Shares of `size` unit cells in `pixels` adjacent intervals of length `ratio` from `start` on: (pixels, size).

    Every interval has an entry, 0 where it lies outside all cells.
    """
    lower = start + ratio * np.arange(pixels)
    first = np.clip(np.floor(lower), 0, size - 1).astype(np.int64)
    cells = first[:, None] + np.arange(int(np.ceil(ratio)) + 1)
    shared = np.minimum((lower + ratio)[:, None], cells + 1.0) - np.maximum(lower[:, None], cells)
    shared = np.where(cells < size, np.maximum(shared, 0.0), 0.0)
    kept = shared > 0
    kept[:, 0] = True
    rows = np.broadcast_to(np.arange(pixels)[:, None], cells.shape)[kept]
    return sparse.csr_array((shared[kept] / ratio, (rows, cells[kept])), shape=(pixels, size))


def real_box(shape: tuple[int, int], sub: SubImager, numbers: FloatArray) -> Box:
    """H of a sub-imager whose view has these numbers, (5,), of which it takes shift and magnification."""
    ratio = float(sub.type.ratio) / (1 + float(numbers[MAGNIFICATION]))
    middle = sub.type.middle(sub.window)
    alone = replace(sub.type, array=(1, 1), steered=())
    axes = [
        BoxAxis(real_overlap(ratio, pixels, centre + float(numbers[number]) - ratio * pixels / 2, size))
        for pixels, centre, number, size in zip(sub.type.pixels, middle, (ROW, COLUMN), shape, strict=True)
    ]
    return Box(alone, *axes)


@dataclass(frozen=True)
class RealBoxes(BoxFootprints):
    """H of sub-imagers of which some have displaced views.

    numbers : (sub-imagers, 5), of `view`;  moved : lens types whose sub-imagers are not where the design has them
    """

    numbers: FloatArray
    moved: tuple[str, ...]

    @cached_property
    def boxes(self) -> tuple[Box, ...]:
        """H of each lens type as designed, and of each sub-imager of the others."""
        boxes: list[Box] = []
        subs = iter(zip(self.camera.sub_imagers, self.numbers, strict=True))
        for lens_type in self.camera.types:
            own = [next(subs) for _ in range(lens_type.count)]
            if lens_type.name in self.moved:
                boxes += [real_box(self.camera.shape, sub, numbers) for sub, numbers in own]
            else:
                boxes += _designed(self.camera, lens_type)
        return tuple(boxes)


def _designed(camera: Camera, lens_type: LensType) -> list[Box]:
    return [designed_box(camera.shape, part) for part in lens_type.on_grids]
