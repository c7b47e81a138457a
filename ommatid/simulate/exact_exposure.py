"""Passes of a rendering whose grid of samples leaves no error, of adjacent sub-imagers of one lens type."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.camera import Camera

from .renderer.renderer import Renderer
from .sampling.exact_grid import margin
from .sampling.passes import Plan


def expose_exactly(
    renderer: Renderer, camera: Camera, indices: Sequence[int], work: Plan, seeds: Sequence[Callable[[int], int]]
) -> Iterator[tuple[slice, FloatArray]]:
    """Yield the readings of adjacent sub-imagers by parts: measurements, and (passes, pixels).

    work : from `exact_plan`;  seeds : of each pass, by the index of a sub-imager. The values of a sub-imager depend on
        no other one: on the fast backends all start together, on scalar they are rendered one by one.
    """
    slices = camera.slices()
    if renderer.is_fast:
        keys = np.array([[seed(index) for seed in seeds] for index in range(len(slices))], dtype=np.int64)
        rows = slice(slices[indices[0]].start, slices[indices[-1]].stop)
        yield from renderer.expose_grid(rows, work, margin(camera, camera.sub_imagers[indices[0]].type), keys)
        return
    for index in indices:
        rows, columns = camera.sub_imagers[index].type.pixels
        pixels: IntArray = np.arange(rows * columns)
        values = renderer.expose_alone(index, pixels, work, lambda number, index=index: seeds[number](index))
        yield slices[index], values
