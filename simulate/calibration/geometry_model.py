"""A sub-imager as a few numbers, and the H that they make.

The numbers, in this order: by how many pixels of f the middle of its view lies lower (`row`) and further right
(`column`) than designed; by which share more its `magnification` is; its `rotation` about the axis in radians, as
`pose.Misalignment` counts it; `k1` of its distortion; and `blur`, the diameter in pixels of f of an even disk over
which every ray is displaced on the target. k2 stays as designed. Areas of overlap are exact; the disk is averaged over
few displacements.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import hypot

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensOptics, SubImager
from ommatid.scenes.optics.blur import blur_of
from ommatid.scenes.optics.distortion import coefficients
from ommatid.scenes.optics.footprints import sub_matrix
from ommatid.scenes.pose import Misalignment, pose_of

Vector = NDArray[np.float64]

UNITS = {
    "row": "pixels of f",
    "column": "pixels of f",
    "magnification": "relative",
    "rotation": "rad",
    "k1": "at r = 1, the target's corner",
    "blur": "pixels of f, diameter of a disk",
}
ROW, COLUMN, MAGNIFICATION, ROTATION, K1, BLUR = range(len(UNITS))
FEW, MANY, WIDE = 6, 23, 1.0  # pairs of displacements, to a blur of `WIDE` and beyond: right to 0.001 / m^2
GOLDEN = np.pi * (3 - 5**0.5)


def designed(camera: Camera, sub: SubImager) -> Vector:
    """The numbers of a sub-imager as designed: all 0 but for its k1 and its disk of defocus."""
    numbers = np.zeros(len(UNITS))
    if sub.type.optics.surfaces is None:
        numbers[K1] = coefficients(sub)[0]
        numbers[BLUR] = blur_of(camera, sub.type).disk
    return numbers


def misaligned(camera: Camera, sub: SubImager, wrong: Misalignment) -> Vector:
    """The numbers of a sub-imager that is misaligned so; tilt, of which they know nothing, is left out."""
    numbers = designed(camera, sub)
    far = camera.distance / sub.depth
    for number, axis in ((COLUMN, 0), (ROW, 1)):
        aside = sub.lens[axis] - sub.patch[axis]
        view = wrong.position[axis] + (aside + wrong.position[axis]) * far / (1 + wrong.focal_length) - aside * far
        numbers[number] = -view / camera.target_pitch
    numbers[MAGNIFICATION], numbers[ROTATION] = wrong.focal_length, wrong.rotation
    return numbers


def misalignment(camera: Camera, sub: SubImager, numbers: Vector) -> Misalignment:
    """What stands where the numbers say; the inverse of `misaligned`."""
    far = camera.distance / sub.depth
    lever = far / (1 + numbers[MAGNIFICATION])
    x, y = (
        (-numbers[number] * camera.target_pitch - (sub.lens[axis] - sub.patch[axis]) * (lever - far)) / (1 + lever)
        for number, axis in ((COLUMN, 0), (ROW, 1))
    )
    return Misalignment(
        (float(x), float(y)), rotation=float(numbers[ROTATION]), focal_length=float(numbers[MAGNIFICATION])
    )


def entries(camera: Camera, sub: SubImager, numbers: Vector, pairs: int | None = None) -> sparse.csr_array:
    """H of a sub-imager: (its pixels, N).

    pairs : of displacements that stand for the disk, absent: as many as H takes
    Raises InputError if the distortion folds the image.
    """
    k1, k2 = float(numbers[K1]), coefficients(sub)[1]
    glass = LensOptics(distortion=(k1, k2) if k1 or k2 else None)
    alone = replace(sub, type=replace(sub.type, optics=glass))
    stands = pose_of(sub, misalignment(camera, sub, numbers))
    blur = float(numbers[BLUR])
    if blur == 0:
        return sub_matrix(camera, alone, stands)
    moves = blur * camera.target_pitch * disk(pairs or (FEW if blur <= WIDE else MANY))
    # A ray that is displaced by (x, y) meets the texel that a straight one would meet were its grid displaced back.
    moved = (replace(stands, lens=(stands.lens[0] - x, stands.lens[1] - y)) for x, y in moves.tolist())
    total = sparse.csr_array((sub.type.pixels[0] * sub.type.pixels[1], camera.unknowns))
    for there in moved:
        total = total + sub_matrix(camera, alone, there)
    return sparse.csr_array(total / len(moves))


@cache
def disk(pairs: int) -> Vector:
    """Points that stand for an even disk of diameter 1, and their opposites: (2 pairs, 2), second moments exact.

    Equal areas along a spiral that turns by the golden angle (Vogel 1979, Mathematical Biosciences 44, 179).
    """
    place = np.arange(pairs)
    radius, angle = np.sqrt((place + 0.5) / pairs) / 2, GOLDEN * place
    half = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate([half, -half])
    values, axes = np.linalg.eigh(points.T @ points / len(points))
    return points @ (axes / np.sqrt(values)) @ axes.T / 4


def scales(camera: Camera, sub: SubImager) -> Vector:
    """Changes of the numbers that move the edge of a view by about a pixel of f."""
    half = float(sub.type.ratio) * hypot(*sub.type.pixels) / 2
    aside = hypot(sub.lens[0] - sub.patch[0], sub.lens[1] - sub.patch[1]) * camera.distance / sub.depth
    furthest = half + aside / camera.target_pitch
    corner = camera.half_diagonal / camera.target_pitch
    return np.array([1.0, 1.0, 1 / half, 1 / half, corner**2 / furthest**3, 1.0])
