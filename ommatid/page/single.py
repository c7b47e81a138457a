"""The sub-image that a page shows beside the estimate: what the camera yields without reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.reconstruct.measured_error import best_single_sub_image, enlarged
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.stack import Stack


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


def shown_sub_image(stack: Stack, truth: FloatArray | None) -> ShownSubImage:
    """Return the best sub-image, or without the truth the central one of the type with the finest pixels."""
    best = best_single_sub_image(stack, truth)
    if best is not None:
        return ShownSubImage(best.name, best.image, True)
    camera = stack.camera
    index = min(range(len(camera.types)), key=lambda index: camera.types[index].ratio)
    lens_type = camera.types[index]
    k, l = (count // 2 for count in lens_type.array)  # noqa: E741
    part = camera.type_slices()[index].start + (k * lens_type.array[1] + l) * lens_type.pixels[0] * lens_type.pixels[1]
    size = lens_type.pixels[0] * lens_type.pixels[1]
    sub, pixels = camera.sub_imager(index, k, l), stack.values[part : part + size].reshape(lens_type.pixels)
    return ShownSubImage(sub.name, enlarged(camera, sub, pixels, np.arange(float(camera.rows))), False)
