"""The sensor face on, with the arrays of lenses and the patches of their sub-images, and one patch of each type."""

from __future__ import annotations

from itertools import product
from math import cos, sin
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType, SubImager

from .lengths import length_words, plural

MOST_DRAWN = 40  # rows and columns of an array; of larger ones every second, third, ... sub-imager
MOST_LINES = 100  # rows and columns of a sub-image whose pixels are drawn
AIRY = 2.44  # diameter of the first dark ring, in wavelengths times f-number


def draw_sensor(axes: Any, camera: Camera, colours: dict[str, str]) -> None:
    """Draw lenses and patches as seen from behind the camera, as in a recorded mosaic: type I is on the left."""
    from matplotlib.collections import EllipseCollection, PolyCollection

    skipped: set[int] = set()
    for index, lens_type in enumerate(camera.types):
        step = max(1, -(-max(lens_type.array) // MOST_DRAWN))
        skipped.add(step)
        places = product(range(0, lens_type.array[0], step), range(0, lens_type.array[1], step))
        subs = [camera.sub_imager(index, k, l) for k, l in places]  # noqa: E741
        colour = colours[lens_type.name]
        patches = [_corners(camera, sub) for sub in subs]
        axes.add_collection(PolyCollection(patches, facecolors=colour, edgecolors=colour, linewidths=0.8, alpha=0.8))
        centres = np.array([sub.lens for sub in subs])
        if lens_type.optics.aperture is not None:
            size = [lens_type.optics.aperture] * len(subs)
            rings: dict[str, Any] = {
                "units": "xy",
                "offset_transform": axes.transData,
                "facecolors": "none",
                "edgecolors": colour,
                "linewidths": 0.7,
            }
            axes.add_collection(EllipseCollection(size, size, [0] * len(subs), offsets=centres, **rings))
        else:
            axes.plot(*centres.T, "+", color=colour, markersize=3, markeredgewidth=0.5)
    (low, high), used = _frame(camera), _used(camera)
    axes.set_xlim(high[0], low[0])  # x to the left, as seen from behind
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", anchor="NW")
    _draw_pitch(axes, camera)
    words = f"sensor from behind: {plural(len(camera.sub_imagers), 'sub-image')} on {used}"
    thinned = f"\none row and column of {max(skipped)} is drawn" if max(skipped) > 1 else ""
    axes.set_title(words + thinned, fontsize=10, loc="left")
    axes.set_xlabel("x (mm)", fontsize=9)
    axes.set_ylabel("y (mm)", fontsize=9)
    axes.tick_params(labelsize=8)


def sensor_aspect(camera: Camera) -> float:
    """Return width over height of the frame in which the sensor is drawn."""
    low, high = _frame(camera)
    return float((high[0] - low[0]) / (high[1] - low[1]))


def _frame(camera: Camera) -> tuple[FloatArray, FloatArray]:
    ends = _ends(camera)
    return ends[0] - camera.lens_pitch, ends[1] + camera.lens_pitch


def _used(camera: Camera) -> str:
    width, height = _ends(camera)[1] - _ends(camera)[0]
    return f"{length_words(width, 3)} x {length_words(height, 3)}"


def _ends(camera: Camera) -> FloatArray:
    """Return the least and the largest x and y of all patches, (2, 2)."""
    corners = np.concatenate([_corners(camera, sub) for sub in camera.sub_imagers])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def _corners(camera: Camera, sub: SubImager) -> FloatArray:
    """Return the corners of a patch in mm, (4, 2) of x and y; a rotation is clockwise as seen from behind."""
    half = np.array(sub.type.pixels)[::-1] * camera.pixel_pitch / 2
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    turn = np.array([[cos(sub.rotation), -sin(sub.rotation)], [sin(sub.rotation), cos(sub.rotation)]])
    return square @ turn + np.array(sub.patch)


def _draw_pitch(axes: Any, camera: Camera) -> None:
    """Draw the distance between two neighbouring lenses below them."""
    arrays = [index for index, lens_type in enumerate(camera.types) if lens_type.array[1] > 1]
    if not arrays:
        return
    index = max(arrays, key=lambda index: camera.types[index].array[0])
    last = camera.types[index].array[0] - 1
    first, second = camera.sub_imager(index, last, 0).lens, camera.sub_imager(index, last, 1).lens
    y = first[1] - 0.75 * camera.lens_pitch
    arrow: dict[str, Any] = {
        "arrowstyle": "<->",
        "color": "#000000",
        "linewidth": 0.8,
        "shrinkA": 0,
        "shrinkB": 0,
        "mutation_scale": 6,
    }
    axes.annotate("", (first[0], y), (second[0], y), arrowprops=arrow)
    words = f"  lens pitch {length_words(camera.lens_pitch)}"
    axes.text(second[0], y, words, ha="left", va="center", fontsize=8)


def draw_sub_images(axes: Any, camera: Camera, colours: dict[str, str]) -> None:
    """Draw the pixels of one sub-image of each lens type side by side, with the Airy disk of a lens to scale."""
    widest = max(lens_type.pixels[1] for lens_type in camera.types)
    tallest = max(lens_type.pixels[0] for lens_type in camera.types)
    left, unit = 0.0, 1e3 * camera.pixel_pitch  # um
    for lens_type in camera.types:
        rows, columns = lens_type.pixels
        _draw_pixels(axes, lens_type, left, unit, colours[lens_type.name])
        middle, disk = (left + columns / 2) * unit, airy_diameter(camera, lens_type)
        if disk is not None:
            _draw_disk(axes, middle, -rows / 2 * unit, 1e3 * disk)
        name, colour = lens_type.name, colours[lens_type.name]
        axes.text(middle, 0.03 * unit * tallest, name, ha="center", va="bottom", fontsize=9, color=colour)
        left += columns + 0.25 * widest
    axes.set_xlim(-0.1 * widest * unit, (left - 0.15 * widest) * unit)
    axes.set_ylim(-1.08 * tallest * unit, 0.2 * tallest * unit)
    axes.set_aspect("equal", anchor="NW")
    grey = "; grey: Airy disk" if any(airy_diameter(camera, lens_type) for lens_type in camera.types) else ""
    axes.set_title(f"one sub-image, {length_words(camera.pixel_pitch)} pixels{grey}", fontsize=10, loc="left")
    axes.set_xlabel("across the sensor (µm)", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_yticks([])


def _draw_pixels(axes: Any, lens_type: LensType, left: float, unit: float, colour: str) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    rows, columns = lens_type.pixels
    frame = Rectangle((left * unit, -rows * unit), columns * unit, rows * unit, facecolor="none", edgecolor=colour)
    axes.add_patch(frame)
    if max(rows, columns) <= MOST_LINES:
        down = [[((left + x) * unit, 0), ((left + x) * unit, -rows * unit)] for x in range(1, columns)]
        along = [[(left * unit, -y * unit), ((left + columns) * unit, -y * unit)] for y in range(1, rows)]
        axes.add_collection(LineCollection([*down, *along], colors=colour, linewidths=0.4, alpha=0.8))


def _draw_disk(axes: Any, x: float, y: float, diameter: float) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((x, y), diameter / 2, facecolor="#808080", alpha=0.45, edgecolor="none"))


def airy_diameter(camera: Camera, lens_type: LensType) -> float | None:
    """Return the diameter of the Airy disk on the sensor in mm, None without an aperture or with rays alone."""
    aperture = lens_type.optics.aperture
    if aperture is None or camera.wavelength is None:
        return None
    return AIRY * camera.wavelength * camera.depth(lens_type) / aperture
