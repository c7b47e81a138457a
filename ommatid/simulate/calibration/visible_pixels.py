"""Pixels of f that the rays of each sensor pixel can reach, from which the spacing of point sources follows.

For ideal pinholes this follows from the geometry; for every other lens some rays are traced ahead.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor
from typing import TYPE_CHECKING

import numpy as np

from ommatid.runtime.arrays import IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

if TYPE_CHECKING:
    from ..renderer.renderer import Renderer

MARGIN = Fraction(1, 1024)  # pixels of f by which rays may land beside a footprint: far more than they are rounded
SCOUTS = 1024  # rays per pixel that are traced ahead
BESIDE = 2  # pixels of f by which other rays may land beside those


@dataclass(frozen=True)
class VisiblePixels:
    """First row and column of f that each pixel of a group may see, (pixels,) each, and the largest number of them."""

    row: IntArray
    column: IntArray
    spacing: int


def visible_pixels(renderer: Renderer, group: str, subset: IntArray | None = None) -> VisiblePixels:
    """Return the visible pixels of a group of the renderer, which is one lens type, or of a subset of its pixels."""
    (lens_type,) = renderer.groups[group]
    if not renderer.camera.is_ideal_pinhole:
        return _traced(renderer, group, subset)
    visible = of_pinholes(renderer.camera, lens_type)
    return visible if subset is None else replace(visible, row=visible.row[subset], column=visible.column[subset])


def of_pinholes(camera: Camera, lens_type: LensType) -> VisiblePixels:
    """Return those of a type of ideal pinholes, whose footprint with its margin touches at most ceil(m) + 2 pixels."""
    rows: list[IntArray] = []
    columns: list[IntArray] = []
    for sub in (sub for sub in camera.sub_imagers if sub.type == lens_type):
        first = [
            np.array([floor(start + lens_type.ratio * number - MARGIN) for number in range(count)], dtype=np.int64)
            for start, count in zip(sub.window, lens_type.pixels, strict=True)
        ]
        rows.append(np.repeat(first[0], lens_type.pixels[1]))
        columns.append(np.tile(first[1], lens_type.pixels[0]))
    return VisiblePixels(np.concatenate(rows), np.concatenate(columns), ceil(lens_type.ratio) + 2)


def _traced(renderer: Renderer, group: str, subset: IntArray | None) -> VisiblePixels:
    camera = renderer.camera
    sizes, (lens_type,) = camera.shape, renderer.groups[group]
    pixels = lens_type.measurements if subset is None else subset.size
    first = [np.full(pixels, size) for size in sizes]
    last = [np.full(pixels, -1) for _ in sizes]
    for block in renderer.blocks(group, SCOUTS, subset):
        texels, _ = renderer.hits(group, SCOUTS, lambda index: index, block, subset)  # only bounds are taken from them
        seen = texels >= 0
        for axis, indices in enumerate(np.divmod(texels, camera.columns)):
            first[axis][block] = np.where(seen, indices, sizes[axis]).min(axis=1)
            last[axis][block] = np.where(seen, indices, -1).max(axis=1)
    beside = BESIDE + ceil(renderer.tail(group))
    ends = [
        (np.clip(low - beside, 0, size - 1), np.clip(high + beside, 0, size - 1))
        for low, high, size in zip(first, last, sizes, strict=True)
    ]
    spacing = max(int((high - low).max()) + 1 for low, high in ends)
    return VisiblePixels(ends[0][0], ends[1][0], spacing)
