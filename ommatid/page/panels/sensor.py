"""Image of the flat sensor as the hardware would record it, seen from behind: sub-images are inverted by their lenses.

Positions are in sensor pixels from the camera's axis, columns towards -x and rows towards -y, as in a recorded mosaic.
The sub-images are small patches on a wide sensor, so they are also shown packed, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.hardware.frames import patches
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.stack import Stack

from ..data import reduced
from .maps import ColourScale, encoded

LEVELS = 65534  # codes of values on a page
MISSING = 65535  # code of a pixel without a value
MOST_VALUES = 180_000
MOST_SUB_IMAGERS = 2000
GAP = 0.12  # between packed sub-images, as a fraction of their size

DIGITAL = "digital number (DN)"
VIEWS = ("packed", "place")  # without the gaps between the sub-images, and at their positions


@dataclass(frozen=True)
class Patch:
    """A sub-image as it lies on the sensor, (rows, columns), or its block means.

    place, packed : (row, column) of the top left corner on the sensor and in the packed view
    """

    lens: str
    k: int
    l: int  # noqa: E741  (the paper's letter)
    size: tuple[int, int]
    image: FloatArray
    place: tuple[float, float]
    packed: tuple[float, float]


@dataclass(frozen=True)
class Mosaic:
    """The patches that are shown, the number of all patches, the side of averaged blocks, unit, and dead pixels."""

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

    @property
    def colours(self) -> ColourScale:
        """Grey between the smallest and the largest value."""
        return ColourScale("grey", *self.ends, self.unit)

    def extent(self, name: str) -> tuple[float, float, float, float]:
        """Return left, right, top and bottom of a view, "packed" or "place", with a margin."""
        corners = np.array([getattr(patch, name) for patch in self.patches])
        ends = corners + np.array([patch.size for patch in self.patches])
        (top, left), (bottom, right) = corners.min(axis=0), ends.max(axis=0)
        margin = 0.02 * max(bottom - top, right - left)
        return left - margin, right + margin, top - margin, bottom + margin

    def aspect(self, name: str) -> float:
        """Return height over width of a view."""
        left, right, top, bottom = self.extent(name)
        return (bottom - top) / (right - left)


def mosaic(stack: Stack, most: int = MOST_VALUES) -> Mosaic:
    """Return the sub-images of a stack at their positions; digital numbers if the stack has them.

    most : number of values, from which on blocks of sensor pixels are averaged
    """
    camera = stack.camera
    values = stack.values if stack.recording is None else stack.recording.digital
    block = 1
    while _value_count(camera, block) > most and block < max(max(lens_type.pixels) for lens_type in camera.types):
        block += 1
    positions, packed, slices = patches(camera), _packed_corners(camera), camera.slices()
    shown: list[Patch] = []
    for index in _shown(camera):
        sub = camera.sub_imagers[index]
        upright = values[slices[index]].reshape(sub.type.pixels)
        shown.append(
            Patch(
                lens=sub.type.name,
                k=sub.k,
                l=sub.l,
                size=sub.type.pixels,
                image=reduced(upright[::-1, ::-1], block).astype(np.float64),
                place=(float(positions[index][0]), float(positions[index][1])),
                packed=packed[index],
            )
        )
    unit = "pixel value (0 to 255)" if stack.recording is None else DIGITAL
    return Mosaic(shown, len(camera.sub_imagers), block, unit, int(np.sum(~np.isfinite(values))))


def _value_count(camera: Camera, block: int) -> int:
    return sum(
        lens_type.count * -(-lens_type.pixels[0] // block) * -(-lens_type.pixels[1] // block)
        for lens_type in camera.types
    )


def _shown(camera: Camera) -> list[int]:
    """Return the indices of all sub-imagers, or of the central ones of each array if there are too many."""
    share = min(1.0, (MOST_SUB_IMAGERS / len(camera.sub_imagers)) ** 0.5)
    return [index for index, sub in enumerate(camera.sub_imagers) if share == 1 or _is_central(sub, share)]


def _is_central(sub: SubImager, share: float) -> bool:
    return all(
        abs(index - (count - 1) / 2) <= share * count / 2
        for index, count in zip((sub.k, sub.l), sub.type.array, strict=True)
    )


def _packed_corners(camera: Camera) -> list[tuple[float, float]]:
    """Return top left corners, (row, column), of the patches with small gaps; lens types side by side."""
    corners: list[tuple[float, float]] = []
    left = 0.0
    for lens_type in camera.types:
        steps = [count * (1 + GAP) for count in lens_type.pixels]
        height = lens_type.array[0] * steps[0]
        for index in range(lens_type.count):
            row, column = divmod(index, lens_type.array[1])
            corners.append((row * steps[0] - height / 2, left + column * steps[1]))
        left += lens_type.array[1] * steps[1] + 2 * GAP * max(lens_type.pixels)
    return corners


def group(mosaic: Mosaic) -> dict[str, Any]:
    """Return the patches for the page's program: their values as codes, one after the other, and their corners."""
    low, high = mosaic.ends
    step = (high - low) / LEVELS
    codes = np.concatenate([_codes(patch.image, low, step).ravel() for patch in mosaic.patches])
    return {
        "name": "sensor",
        "block": mosaic.block,
        "scale": mosaic.colours.plain(),
        "step": step,
        "missing": MISSING,
        "values": encoded(codes),
        "patches": [
            [patch.lens, patch.k, patch.l, *patch.image.shape, *patch.packed, *patch.place] for patch in mosaic.patches
        ],
        "views": {name: mosaic.extent(name) for name in VIEWS},
    }


def _codes(image: FloatArray, low: float, step: float) -> NDArray[np.uint16]:
    codes = np.full(image.shape, MISSING, dtype=np.uint16)
    known = np.isfinite(image)
    codes[known] = np.rint((image[known] - low) / step).astype(np.uint16)
    return codes


def words(mosaic: Mosaic) -> str:
    """Return number, order and range of the sub-images in words."""
    names = [patch.lens for patch in mosaic.patches]
    counts = [f"{names.count(name)} of lens type {name}" for name in dict.fromkeys(names)]
    low, high = mosaic.ends
    words = (
        f"{len(names)} sub-images ({', '.join(counts)}), inverted as the lenses project them, lens types from left to"
        f" right; range of the {mosaic.unit}: {low:.4g} to {high:.4g}"
    )
    return words + (f"; {mosaic.dead} sensor pixels are dead" if mosaic.dead else "")
