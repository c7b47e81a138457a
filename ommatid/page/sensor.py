"""The flat sensor as the hardware would record it, seen from behind: sub-images upside down behind their lenses.

Places are sensor pixels from the camera's axis, columns towards -x and rows towards -y, as in a recorded mosaic. The
sub-images are small patches on a wide sensor, so they are also shown packed, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.hardware.frames import patches
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.stack import Stack

from . import plots
from .data import reduced
from .plots import Colours

LEVELS = 65534  # in which values are told apart on a page; the next number stands for a pixel without a value
MISSING = 65535
MOST_VALUES = 180_000
MOST_SHOWN = 2000  # sub-imagers
GAP = 0.12  # of a sub-image, between two that are packed

UNITS = {False: "value (0 to 255)", True: "digital number (DN)"}
AXES = {
    "packed": ("packed columns", "packed rows"),
    "place": ("sensor pixels from the axis, along columns", "along rows"),
}

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Patch:
    """A sub-image as it lies on the sensor, (rows, columns) or their block means, and where.

    place, packed : top left corner as (row, column), on the sensor and packed
    """

    lens: str
    k: int
    l: int  # noqa: E741  (the paper's letter)
    size: tuple[int, int]
    image: Numbers
    place: tuple[float, float]
    packed: tuple[float, float]


@dataclass(frozen=True)
class Mosaic:
    """The patches that are shown, of how many, the blocks over which they are averaged, and what they hold."""

    patches: list[Patch]
    count: int
    block: int
    unit: str
    dead: int

    @property
    def ends(self) -> tuple[float, float]:
        """Smallest and largest value."""
        known = np.concatenate([patch.image[np.isfinite(patch.image)] for patch in self.patches])
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, WHITE)
        return (low, high) if high > low else (low - 0.5, high + 0.5)


def mosaic(stack: Stack, most: int = MOST_VALUES) -> Mosaic:
    """The sub-images of a stack where they were recorded; digital numbers where there are any."""
    camera = stack.camera
    values = stack.values if stack.recording is None else stack.recording.digital
    block = 1
    while _values(camera, block) > most and block < max(max(kind.pixels) for kind in camera.types):
        block += 1
    places, packed = patches(camera), _packed(camera)
    shown = _shown(camera)
    slices = camera.slices()
    found: list[Patch] = []
    for number in shown:
        sub = camera.sub_imagers[number]
        upright = values[slices[number]].reshape(sub.type.pixels)
        found.append(
            Patch(
                sub.type.name,
                sub.k,
                sub.l,
                sub.type.pixels,
                reduced(upright[::-1, ::-1], block).astype(np.float64),
                (float(places[number][0]), float(places[number][1])),
                packed[number],
            )
        )
    unit = UNITS[stack.recording is not None]
    return Mosaic(found, len(camera.sub_imagers), block, unit, int(np.sum(~np.isfinite(values))))


def _values(camera: Camera, block: int) -> int:
    return sum(kind.count * -(-kind.pixels[0] // block) * -(-kind.pixels[1] // block) for kind in camera.types)


def _shown(camera: Camera) -> list[int]:
    """Which sub-imagers: all, or those in the middle of each array where they are too many."""
    share = min(1.0, (MOST_SHOWN / len(camera.sub_imagers)) ** 0.5)
    return [number for number, sub in enumerate(camera.sub_imagers) if share == 1 or _central(sub.type, sub, share)]


def _central(kind: LensType, sub: Any, share: float) -> bool:
    return all(
        abs(place - (count - 1) / 2) <= share * count / 2
        for place, count in zip((sub.k, sub.l), kind.array, strict=True)
    )


def _packed(camera: Camera) -> list[tuple[float, float]]:
    """Top left corners, (row, column), of the patches with little between them; lens types side by side."""
    found: list[tuple[float, float]] = []
    left = 0.0
    for kind in camera.types:
        steps = [count * (1 + GAP) for count in kind.pixels]
        tall = kind.array[0] * steps[0]
        for place in range(kind.count):
            row, column = divmod(place, kind.array[1])
            found.append((row * steps[0] - tall / 2, left + column * steps[1]))
        left += kind.array[1] * steps[1] + 2 * GAP * max(kind.pixels)
    return found


def figures(shown: Mosaic) -> list[Any]:
    """The packed view and the one at true places, from one source."""
    low, high = shown.ends
    step = (high - low) / LEVELS
    columns: dict[str, list[Any]] = {
        "image": [np.ascontiguousarray(_codes(patch.image, low, step)) for patch in shown.patches],
        "lens": [patch.lens for patch in shown.patches],
        "k": [patch.k for patch in shown.patches],
        "l": [patch.l for patch in shown.patches],
    }
    for name in ("packed", "place"):
        columns[f"{name}_row"] = [getattr(patch, name)[0] for patch in shown.patches]
        columns[f"{name}_column"] = [getattr(patch, name)[1] for patch in shown.patches]
    columns["height"] = [patch.image.shape[0] * shown.block for patch in shown.patches]
    columns["width"] = [patch.image.shape[1] * shown.block for patch in shown.patches]
    data = plots.source(columns, "sensor")
    colours = Colours(plots.GREY, low, high, shown.unit)
    made: list[Any] = []
    for name in ("packed", "place"):
        tips = [
            ("lens type", "@lens"),
            ("sub-imager k, l", "@k, @l"),
            ("its row on the sensor", f"$y{{{name}_row}}"),
            ("its column on the sensor", f"$x{{{name}_column}}"),
            ("value", "@image{value}"),
        ]
        formatters = {"$y": plots.within(f"{name}_row", data), "$x": plots.within(f"{name}_column", data)}
        formatters["@image"] = plots.decoded(low, step, MISSING)
        made.append(
            plots.map_figure(
                name,
                data,
                "image",
                colours,
                _view(shown, name),
                tips,
                places=(f"{name}_column", f"{name}_row", "width", "height"),
                axes=AXES[name],
                mapper=colours.mapper(0, LEVELS, high_color=plots.NOTHING),
                formatters=formatters,
                ground=plots.DARK if name == "place" else None,
            )
        )
    return made


def extent(shown: Mosaic, name: str) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of what is shown `packed` or at its `place`, with a margin."""
    corners = np.array([getattr(patch, name) for patch in shown.patches])
    ends = corners + np.array([patch.size for patch in shown.patches])
    (top, left), (bottom, right) = corners.min(axis=0), ends.max(axis=0)
    margin = 0.02 * max(bottom - top, right - left)
    return left - margin, right + margin, top - margin, bottom + margin


def _view(shown: Mosaic, name: str) -> plots.View:
    return plots.view(*extent(shown, name))


def _codes(image: Numbers, low: float, step: float) -> NDArray[np.uint16]:
    codes = np.full(image.shape, MISSING, dtype=np.uint16)
    known = np.isfinite(image)
    codes[known] = np.rint((image[known] - low) / step).astype(np.uint16)
    return codes


def words(shown: Mosaic) -> str:
    """The mosaic for those who do not see it."""
    kinds = list(dict.fromkeys(patch.lens for patch in shown.patches))
    each = [f"{sum(patch.lens == kind for patch in shown.patches)} of lens type {kind}" for kind in kinds]
    low, high = shown.ends
    told = f"{len(shown.patches)} sub-images, {', '.join(each)}, upside down as lenses turn them, left to right in the"
    told += f" order of the lens types; from {low:.4g} to {high:.4g}, {shown.unit}"
    told += f"; {shown.dead} sensor pixels are dead" if shown.dead else ""
    return told
