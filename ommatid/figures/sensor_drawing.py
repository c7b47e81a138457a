"""The sensor face on, with the arrays of lenses and the patches of their sub-images, and one patch of each type."""

from __future__ import annotations

from itertools import product
from math import cos, sin
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.geometry.optical_terms import OpticalTerms
from ommatid.scenes.lens_type import LensType, SubImager

from .saving import INK

UNITS = ((1e3, "m"), (1.0, "mm"), (1e-3, "µm"), (1e-6, "nm"))  # in mm


def length_words(length: float, digits: int = 4) -> str:
    """Return a length given in mm with its unit: 0.006 is 6 µm."""
    size, unit = next((entry for entry in UNITS if abs(length) >= entry[0] * (1 - 1e-9)), UNITS[-1])
    return f"{length / size:.{digits}g} {unit}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


MOST_DRAWN = 40  # rows and columns of an array; of larger ones every second, third, ... sub-imager
MOST_LINES = 100  # rows and columns of a sub-image whose pixels are drawn
ARROW: dict[str, Any] = {"arrowstyle": "<->", "color": INK, "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0}


def draw_sensor(axes: Any, camera: Camera, terms: OpticalTerms, colours: dict[str, str]) -> None:
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
    low, high = _frame(camera, terms)
    axes.set_xlim(high[0], low[0])  # x to the left, as seen from behind
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", anchor="NW")
    _draw_pitch(axes, camera)
    _draw_outline(axes, camera, terms)
    words = f"sensor from behind: {plural(len(camera.sub_imagers), 'sub-image')} on {_used(terms)}"
    thinned = f"\none row and column of {max(skipped)} is drawn" if max(skipped) > 1 else ""
    axes.set_title(words + thinned, fontsize=10, loc="left")
    axes.set_xlabel("x (mm)", fontsize=9)
    axes.set_ylabel("y (mm)", fontsize=9)
    axes.tick_params(labelsize=8)


def sensor_aspect(camera: Camera, terms: OpticalTerms) -> float:
    """Return width over height of the frame in which the sensor is drawn."""
    low, high = _frame(camera, terms)
    return float((high[0] - low[0]) / (high[1] - low[1]))


def _frame(camera: Camera, terms: OpticalTerms) -> tuple[FloatArray, FloatArray]:
    low, high = _ends(camera)
    if terms.sensor_size is None:
        return low - camera.lens_pitch, high + camera.lens_pitch
    half = np.maximum((high - low) / 2 + camera.lens_pitch, 0.55 * np.array(terms.sensor_size[::-1]))
    return (low + high) / 2 - half, (low + high) / 2 + half


def _used(terms: OpticalTerms) -> str:
    return " x ".join(length_words(side, 3) for side in terms.sensor_extent)


def _draw_outline(axes: Any, camera: Camera, terms: OpticalTerms) -> None:
    """Draw the outline of the sensor around the middle of the sub-images, if the scene gives its size."""
    from matplotlib.patches import Rectangle

    if terms.sensor_size is None or terms.sensor_share is None:
        return
    (height, width), (x, y) = terms.sensor_size, _ends(camera).mean(axis=0)
    axes.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, facecolor="none", edgecolor=INK))
    words = f"sensor {length_words(height)} x {length_words(width)}, {100 * terms.sensor_share:.2g} % used"
    axes.text(x + 0.49 * width, y + 0.485 * height, words, ha="left", va="top", fontsize=8)


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
    axes.annotate("", (first[0], y), (second[0], y), arrowprops={**ARROW, "mutation_scale": 6})
    words = f"lens pitch {length_words(camera.lens_pitch)}"
    write_beside(axes, words, (second[0], y), (6, 0), va="center", fontsize=8)


def write_beside(axes: Any, words: str, place: tuple[float, float], offset: tuple[float, float], **style: Any) -> None:
    """Write words to the left or to the right of a place, at an offset in 1/72 inch."""
    side = "left" if offset[0] > 0 else "right"
    axes.annotate(words, place, xytext=offset, textcoords="offset points", ha=side, **style)


def draw_sub_images(axes: Any, camera: Camera, terms: OpticalTerms, colours: dict[str, str]) -> None:
    """Draw the pixels of one sub-image of each lens type side by side, with the Airy disk of a lens to scale."""
    widest = max(lens_type.pixels[1] for lens_type in camera.types)
    tallest = max(lens_type.pixels[0] for lens_type in camera.types)
    left, unit = 0.0, 1e3 * camera.pixel_pitch  # um
    for lens_type, lens_terms in zip(camera.types, terms.types, strict=True):
        rows, columns = lens_type.pixels
        _draw_pixels(axes, lens_type, left, unit, colours[lens_type.name])
        middle = (left + columns / 2) * unit
        if lens_terms.airy_diameter is not None:
            _draw_disk(axes, middle, -rows / 2 * unit, lens_terms.airy_diameter * unit)
        name, colour = lens_type.name, colours[lens_type.name]
        axes.text(middle, 0.03 * unit * tallest, name, ha="center", va="bottom", fontsize=9, color=colour)
        left += columns + 0.25 * widest
    axes.set_xlim(-0.1 * widest * unit, (left - 0.15 * widest) * unit)
    axes.set_ylim(-1.08 * tallest * unit, 0.2 * tallest * unit)
    axes.set_aspect("equal", anchor="NW")
    grey = "; grey: Airy disk" if any(lens_terms.airy_diameter for lens_terms in terms.types) else ""
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
