"""Which pixels of f the rays of each sensor pixel can reach: as far as grids of point sources have to stand apart.

For pinholes that stand where they should this follows from the geometry; for every other lens some rays are sent ahead.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import ceil, floor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

if TYPE_CHECKING:
    from ..renderer.renderer import Renderer

MARGIN = Fraction(1, 1024)  # pixels of f by which rays may land beside a footprint: far more than they are rounded
SCOUTS = 1024  # rays a pixel that are sent ahead
BESIDE = 2  # pixels of f by which others may land beside those


@dataclass(frozen=True)
class VisiblePixels:
    """The first row and column of f that each pixel of a group may see, (pixels,) each, and how many at most."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    apart: int


def visible_pixels(rig: Renderer, group: str) -> VisiblePixels:
    """Of the pixels of a group of the rig, which is one lens type."""
    (kind,) = rig.groups[group]
    if rig.camera.is_ideal_pinhole:
        return of_pinholes(rig.camera, kind)
    return _scouted(rig, group)


def of_pinholes(camera: Camera, kind: LensType) -> VisiblePixels:
    """Of a lens type of a perfect camera: a footprint and its margin touch at most ceil(m) + 2 pixels."""
    rows: list[NDArray[np.int64]] = []
    columns: list[NDArray[np.int64]] = []
    for sub in (sub for sub in camera.sub_imagers if sub.type == kind):
        first = [
            np.array([floor(start + kind.ratio * number - MARGIN) for number in range(count)], dtype=np.int64)
            for start, count in zip(sub.window, kind.pixels, strict=True)
        ]
        rows.append(np.repeat(first[0], kind.pixels[1]))
        columns.append(np.tile(first[1], kind.pixels[0]))
    return VisiblePixels(np.concatenate(rows), np.concatenate(columns), ceil(kind.ratio) + 2)


def _scouted(rig: Renderer, group: str) -> VisiblePixels:
    camera = rig.camera
    sizes, (kind,) = camera.shape, rig.groups[group]
    first = [np.full(kind.measurements, size) for size in sizes]
    last = [np.full(kind.measurements, -1) for _ in sizes]
    for block in rig.blocks(group, SCOUTS):
        texels, _ = rig.hits(group, SCOUTS, lambda place: place, block)  # bounds: not used for anything else
        seen = texels >= 0
        for axis, places in enumerate(np.divmod(texels, camera.columns)):
            first[axis][block] = np.where(seen, places, sizes[axis]).min(axis=1)
            last[axis][block] = np.where(seen, places, -1).max(axis=1)
    beside = BESIDE + ceil(rig.tail(group))
    ends = [
        (np.clip(low - beside, 0, size - 1), np.clip(high + beside, 0, size - 1))
        for low, high, size in zip(first, last, sizes, strict=True)
    ]
    apart = max(int((last - first).max()) + 1 for first, last in ends)
    return VisiblePixels(ends[0][0], ends[1][0], apart)
