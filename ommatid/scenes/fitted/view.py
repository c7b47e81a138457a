"""The view of a sub-imager in five numbers, and the H that follows from it where footprints are sharp.

The numbers, in this order: the shift of the middle of its view, in pixels of f downwards (`row`) and to the right
(`column`), from its design; the relative error of its `magnification`; its `rotation` about the axis in radians, as in
`pose.Misalignment`; and `k1` of its distortion. k2 is as designed. A view grows as its lens comes nearer to the sensor,
and turns with the sensor.

H of box footprints is applied without being stored, however their views are displaced and magnified.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, pi

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..camera import Camera
from ..lens_type import LensOptics, LensType, SubImager
from ..observation import Entries, ObservationPart
from ..optics.boxes import Box, BoxAxis, designed_box
from ..pose import Misalignment, pose_of

UNITS = {
    "row": "pixels of f",
    "column": "pixels of f",
    "magnification": "relative",
    "rotation": "rad",
    "k1": "at r = 1, the target's corner",
}
COUNT = len(UNITS)
LEAST = np.array([-1e6, -1e6, -0.99, -2 * pi, -1e6])  # of the numbers in a file
MOST = np.array([1e6, 1e6, 99.0, 2 * pi, 1e6])
ROW, COLUMN, MAGNIFICATION, ROTATION, K1 = range(COUNT)
NEAR = 1e-3  # pixels of f, for derivatives of H: below the errors of views, above what rounding of areas shows


def designed(sub: SubImager) -> FloatArray:
    """Return the numbers of a sub-imager as designed, (5,): all 0 but its k1."""
    numbers = np.zeros(COUNT)
    numbers[K1] = 0.0 if sub.type.optics.distortion is None else sub.type.optics.distortion[0]
    return numbers


def misaligned(camera: Camera, sub: SubImager, error: Misalignment) -> FloatArray:
    """Return the numbers of a misaligned sub-imager; tilt, which they do not describe, is ignored."""
    numbers = designed(sub)
    far = sub.distance / sub.depth
    for number, axis in ((COLUMN, 0), (ROW, 1)):
        aside = sub.lens[axis] - sub.patch[axis]
        view = error.position[axis] + (aside + error.position[axis]) * far / (1 + error.focal_length) - aside * far
        numbers[number] = -view / camera.target_pitch
    numbers[MAGNIFICATION], numbers[ROTATION] = error.focal_length, error.rotation
    return numbers


def misalignment(camera: Camera, sub: SubImager, numbers: FloatArray) -> Misalignment:
    """Return the misalignment that has these numbers; the inverse of `misaligned`."""
    far = sub.distance / sub.depth
    lever = far / (1 + numbers[MAGNIFICATION])
    x, y = (
        (-numbers[number] * camera.target_pitch - (sub.lens[axis] - sub.patch[axis]) * (lever - far)) / (1 + lever)
        for number, axis in ((COLUMN, 0), (ROW, 1))
    )
    return Misalignment(
        (float(x), float(y)), rotation=float(numbers[ROTATION]), focal_length=float(numbers[MAGNIFICATION])
    )


def entries(camera: Camera, sub: SubImager, numbers: FloatArray) -> sparse.csr_array:
    """Return H of a sub-imager, (its pixels, N), by exact overlap of areas.

    Raises InputError if the distortion folds the image.
    """
    from ..optics.distortion import coefficients
    from ..optics.footprints import sub_matrix

    k1, k2 = float(numbers[K1]), coefficients(sub)[1]
    optics = LensOptics(distortion=(k1, k2) if k1 or k2 else None)
    alone = replace(sub, type=replace(sub.type, optics=optics))
    return sub_matrix(camera, alone, pose_of(sub, misalignment(camera, sub, numbers)))


def offsets(sub: SubImager, pixels: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the middles of pixels (i, j) as designed, from the middle of the view, in rows and columns of f."""
    ratio, sizes = float(sub.type.ratio), sub.type.pixels
    down, across = (ratio * (index + 0.5 - size / 2) for index, size in zip(pixels, sizes, strict=True))
    return down, across


def displacements(
    camera: Camera, sub: SubImager, pixels: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return how far a view's pixels (i, j) move per unit of each number: (pixels, 5), in rows and in columns of f.

    To first order around the design, without rotation; of k1 the move towards the lens's axis on the target.
    """
    down, across = offsets(sub, pixels)
    ones, none = np.ones_like(down), np.zeros_like(down)
    middle = sub.type.middle(sub.window)
    axis = camera.rows / 2 - sub.lens[1] / camera.target_pitch, camera.columns / 2 - sub.lens[0] / camera.target_pitch
    aside = down + middle[0] - axis[0], across + middle[1] - axis[1]
    tall, wide = (float(side) ** 2 for side in sub.type.footprint)
    scale = (camera.target_pitch / camera.half_diagonal) ** 2
    # Means of (x^2 + y^2) y and of (x^2 + y^2) x over a footprint, not those of its middle.
    upward, sideways = (
        (np.square(aside[0]) + np.square(aside[1]) + (3 * along + beside) / 12) * scale
        for along, beside in ((tall, wide), (wide, tall))
    )
    rows = np.column_stack([ones, none, -down, across, -aside[0] * upward])
    columns = np.column_stack([none, ones, -across, -down, -aside[1] * sideways])
    return rows, columns


def scales(camera: Camera, sub: SubImager) -> FloatArray:
    """Return the changes of the numbers that move the edge of a view by about a pixel of f: (5,)."""
    half = float(sub.type.ratio) * hypot(*sub.type.pixels) / 2
    aside = hypot(sub.lens[0] - sub.patch[0], sub.lens[1] - sub.patch[1]) * sub.distance / sub.depth
    furthest = half + aside / camera.target_pitch
    corner = camera.half_diagonal / camera.target_pitch
    return np.array([1.0, 1.0, 1 / half, 1 / half, corner**2 / furthest**3])


def real_overlap(lower: FloatArray, length: float, size: int) -> sparse.csr_array:
    """Shares of `size` unit cells in intervals of a length that begin at `lower`, (intervals,): (intervals, size).

    Every interval has an entry, 0 where it lies outside all cells.
    """
    first = np.clip(np.floor(lower), 0, size - 1).astype(np.int64)
    cells = first[:, None] + np.arange(int(np.ceil(length)) + 1)
    shared = np.minimum((lower + length)[:, None], cells + 1.0) - np.maximum(lower[:, None], cells)
    shared = np.where(cells < size, np.maximum(shared, 0.0), 0.0)
    kept = shared > 0
    kept[:, 0] = True
    rows = np.broadcast_to(np.arange(lower.size)[:, None], cells.shape)[kept]
    return sparse.csr_array((shared[kept] / length, (rows, cells[kept])), shape=(lower.size, size))


def real_box(shape: tuple[int, int], sub: SubImager, numbers: FloatArray) -> Box:
    """H of a sub-imager whose view has these numbers, (5,), of which it takes shift and magnification."""
    ratio = float(sub.type.ratio) / (1 + float(numbers[MAGNIFICATION]))
    middle = sub.type.middle(sub.window)
    alone = replace(sub.type, array=(1, 1), steered=())
    axes: list[sparse.csr_array] = []
    for axis, (pixels, centre, number, size) in enumerate(
        zip(sub.type.pixels, middle, (ROW, COLUMN), shape, strict=True)
    ):
        length = float(sub.type.open[axis]) * ratio
        start = centre + float(numbers[number]) - ratio * pixels / 2 + (ratio - length) / 2
        axes.append(real_overlap(start + ratio * np.arange(pixels, dtype=np.float64), length, size))
    axes[0].data *= float(sub.type.light)
    return Box(alone, *map(BoxAxis, axes))


def part_of(camera: Camera, sub: SubImager, numbers: FloatArray) -> Box | Entries:
    """H of a sub-imager: a box where its footprints are boxes, else entries. Raises as `entries` does."""
    turned = numbers[ROTATION] or numbers[K1] or sub.rotation or sub.type.optics.distortion is not None
    return Entries(entries(camera, sub, numbers), camera.shape) if turned else real_box(camera.shape, sub, numbers)


def slopes(camera: Camera, sub: SubImager, numbers: FloatArray) -> list[ObservationPart]:
    """Return the changes of H of a sub-imager per pixel of f by which its view is shifted, down and across.

    They are differences of H itself, so that they are right within pixels of f and where the target ends: light that a
    footprint loses beside it changes with the shift. Raises as `entries` does.
    """

    def slope(one: sparse.csr_array, other: sparse.csr_array) -> sparse.csr_array:
        return sparse.csr_array((one - other) / (2 * NEAR))

    found = list[ObservationPart]()
    for number in (ROW, COLUMN):
        step = NEAR * (np.arange(COUNT) == number)
        ahead, behind = (part_of(camera, sub, numbers + sign * step) for sign in (1, -1))
        if isinstance(ahead, Entries) or isinstance(behind, Entries):
            found.append(Entries(slope(ahead.to_sparse(), behind.to_sparse()), camera.shape))
        elif number == ROW:
            found.append(replace(ahead, down=BoxAxis(slope(ahead.down.shares, behind.down.shares))))
        else:
            found.append(replace(ahead, across=BoxAxis(slope(ahead.across.shares, behind.across.shares))))
    return found


def boxes_of(camera: Camera, lens_type: LensType, views: list[tuple[SubImager, FloatArray]]) -> list[Box]:
    """H of a lens type's sub-imagers, whose views have these numbers, (5,) each: one part where none is displaced."""
    if any(numbers.any() for _, numbers in views):
        return [real_box(camera.shape, sub, numbers) for sub, numbers in views]
    return [designed_box(camera.shape, part) for part in lens_type.on_grids]
