"""Where the sub-imagers of an array look, and where their patches lie on the sensor.

Windows of single sub-imagers may lie off the grid of their array; patches must lie apart and fit the sensor. Positions
are rows and columns of f from its top left corner, and millimetres on the sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from math import ceil, cos, floor, sin
from pathlib import Path

import numpy as np

from ommatid.runtime.arrays import BoolArray
from ommatid.runtime.errors import InputError

from .lens_type import LensType, Steering, SubImager
from .scene import Scene
from .tables.camera import SubImagerTable


def with_steering(
    lens_type: LensType, tables: Sequence[SubImagerTable], shape: tuple[int, int], source: Path
) -> LensType:
    """Return a lens type whose named sub-imagers look at their own windows.

    shape : rows and columns of f
    Raises InputError, which names the scene file, for a window that reaches beyond the target.
    """
    most = [size - lens_type.ratio * count for size, count in zip(shape, lens_type.pixels, strict=True)]
    steered: list[Steering] = []
    for table in tables:
        window = lens_type.view(*table.at).window if table.window is None else table.window
        if window[0] > most[0] or window[1] > most[1]:
            raise InputError(
                f"{source}: camera.lens.{lens_type.name}.sub_imager: the window of the one at {list(table.at)} begins"
                f" at row {window[0]}, column {window[1]}, expected at most row {most[0]}, column {most[1]}, so that it"
                f" lies in a target of {shape[0]} x {shape[1]} pixels"
            )
        steered.append(Steering(*table.at, window, table.rotation or 0.0))
    return replace(lens_type, steered=tuple(steered))


def whole_pixels(lens_type: LensType, shape: tuple[int, int]) -> BoolArray:
    """Return True for the pixels of f, (rows, columns), that some sub-imager of a lens type sees as a whole."""
    seen = np.zeros(shape, dtype=np.bool_)
    for part in lens_type.on_grids:
        if part.rotation:
            seen |= _in_rotated_window(part, shape)
            continue
        axes = [np.zeros(size, dtype=np.bool_) for size in shape]
        for axis, pixels in enumerate(axes):
            for start in part.starts(axis):
                pixels[ceil(start) : floor(start + part.ratio * part.pixels[axis])] = True
        seen |= np.logical_and.outer(*axes)
    return seen


def _in_rotated_window(single: LensType, shape: tuple[int, int]) -> BoolArray:
    """Return True for the pixels whose four corners lie in the rotated window of a lens type's only sub-imager."""
    middle = single.middle(single.view(0, 0).window)
    edges = [np.arange(size + 1) - at for size, at in zip(shape, middle, strict=True)]
    down, across = edges[0][:, None], edges[1][None, :]
    along = cos(single.rotation) * down - sin(single.rotation) * across
    aside = sin(single.rotation) * down + cos(single.rotation) * across
    half = [float(single.ratio) * count / 2 * (1 + 1e-12) for count in single.pixels]
    corners = (np.abs(along) <= half[0]) & (np.abs(aside) <= half[1])
    return corners[1:, 1:] & corners[1:, :-1] & corners[:-1, 1:] & corners[:-1, :-1]


def check_overlap(
    types: Sequence[LensType], sub_imager: Callable[[int, int, int], SubImager], pixel_pitch: float, source: Path
) -> None:
    """Raise InputError, which names the scene file, if patches overlap; a rotated one is the upright box around it.

    sub_imager : from the index of a lens type, k and l
    """
    # The patches of a type form a regular grid and the types lie side by side, so that these columns suffice.
    steered, subs = any(lens_type.steered for lens_type in types), list[SubImager]()
    for index, (rows, columns) in enumerate(lens_type.array for lens_type in types):
        chosen = range(columns) if steered else sorted({0, min(1, columns - 1), columns - 1})
        subs += [sub_imager(index, *place) for place in product(range(rows), chosen)]
    middles = np.array([sub.patch for sub in subs])
    halves = np.array([_half_extent(sub, pixel_pitch) for sub in subs])
    for index, sub in enumerate(subs[:-1]):
        needed = (halves[index + 1 :] + halves[index]) * (1 - 1e-9)
        overlapping = (np.abs(middles[index + 1 :] - middles[index]) < needed).all(axis=1)
        if overlapping.any():
            other = subs[index + 1 + int(overlapping.argmax())]
            raise InputError(
                f"{source}: camera.lens_pitch: the sub-images {sub.name} and {other.name} overlap on the sensor; widen"
                f" the pitch{', or move one of their windows' if steered else ''}"
            )


def _half_extent(sub: SubImager, pixel_pitch: float) -> tuple[float, float]:
    """Return half the width and height, mm, of the upright box around a patch."""
    rows, columns = sub.type.pixels
    along, aside = abs(cos(sub.rotation)) * pixel_pitch / 2, abs(sin(sub.rotation)) * pixel_pitch / 2
    return along * columns + aside * rows, along * rows + aside * columns


ROUNDING = 1 + 1e-9


def sensor_extent(sub_imagers: Sequence[SubImager], pixel_pitch: float) -> tuple[float, float]:
    """Return height and width of the smallest upright rectangle that holds all patches, in mm."""
    middles = np.array([sub.patch for sub in sub_imagers])
    halves = np.array([_half_extent(sub, pixel_pitch) for sub in sub_imagers])
    width, height = ((middles + halves).max(axis=0) - (middles - halves).min(axis=0)).tolist()
    return height, width


def check_sensor(scene: Scene, sub_imagers: Sequence[SubImager]) -> None:
    """Raise InputError, which names the scene file, if the sub-images do not fit the sensor that the scene gives."""
    if scene.camera.sensor is None:
        return
    (height, width), size = sensor_extent(sub_imagers, scene.camera.pixel_pitch), scene.camera.sensor.size
    if height <= size[0] * ROUNDING and width <= size[1] * ROUNDING:
        return
    remedy = "use fewer sub-imagers, a smaller camera.lens_pitch or a larger sensor"
    if height <= size[1] and width <= size[0]:
        remedy = "they fit if the sensor is turned: its height comes first"
    raise InputError(
        f"{scene.source}: camera.sensor.size: the sub-images of all arrays, side by side, take {height:.4g} x"
        f" {width:.4g} mm (height x width), but the sensor has {size[0]:.4g} x {size[1]:.4g} mm; {remedy}"
    )
