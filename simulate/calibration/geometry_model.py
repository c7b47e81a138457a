"""Geometry of a sub-imager in six parameters, and the H that follows from it.

The parameters, in this order: the shift of the middle of its view, in pixels of f downwards (`row`) and to the right
(`column`), from its design; the relative error of its `magnification`; its `rotation` about the axis in radians, as in
`pose.Misalignment`; `k1` of its distortion; and `blur`, the diameter in pixels of f of a uniform disk over which rays
are displaced on the target. k2 is as designed. Areas of overlap are exact; the disk is averaged over few displacements.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import hypot

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensOptics, SubImager
from ommatid.scenes.optics.blur import blur_of
from ommatid.scenes.optics.distortion import coefficients
from ommatid.scenes.optics.footprints import sub_matrix
from ommatid.scenes.pose import Misalignment, pose_of

UNITS = {
    "row": "pixels of f",
    "column": "pixels of f",
    "magnification": "relative",
    "rotation": "rad",
    "k1": "at r = 1, the target's corner",
    "blur": "pixels of f, diameter of a disk",
}
ROW, COLUMN, MAGNIFICATION, ROTATION, K1, BLUR = range(len(UNITS))
FEW, MANY, WIDE = 6, 23, 1.0  # pairs of displacements, up to a blur of `WIDE` and beyond: accurate to 0.001 / m^2
GOLDEN = np.pi * (3 - 5**0.5)


def designed(camera: Camera, sub: SubImager) -> FloatArray:
    """Return the parameters of a sub-imager as designed: all 0 but its k1 and its disk of defocus."""
    numbers = np.zeros(len(UNITS))
    if sub.type.optics.surfaces is None:
        numbers[K1] = coefficients(sub)[0]
        numbers[BLUR] = blur_of(camera, sub.type).disk
    return numbers


def misaligned(camera: Camera, sub: SubImager, error: Misalignment) -> FloatArray:
    """Return the parameters of a misaligned sub-imager; tilt, which they do not describe, is ignored."""
    numbers = designed(camera, sub)
    far = camera.distance / sub.depth
    for number, axis in ((COLUMN, 0), (ROW, 1)):
        aside = sub.lens[axis] - sub.patch[axis]
        view = error.position[axis] + (aside + error.position[axis]) * far / (1 + error.focal_length) - aside * far
        numbers[number] = -view / camera.target_pitch
    numbers[MAGNIFICATION], numbers[ROTATION] = error.focal_length, error.rotation
    return numbers


def misalignment(camera: Camera, sub: SubImager, numbers: FloatArray) -> Misalignment:
    """Return the misalignment that has these parameters; the inverse of `misaligned`."""
    far = camera.distance / sub.depth
    lever = far / (1 + numbers[MAGNIFICATION])
    x, y = (
        (-numbers[number] * camera.target_pitch - (sub.lens[axis] - sub.patch[axis]) * (lever - far)) / (1 + lever)
        for number, axis in ((COLUMN, 0), (ROW, 1))
    )
    return Misalignment(
        (float(x), float(y)), rotation=float(numbers[ROTATION]), focal_length=float(numbers[MAGNIFICATION])
    )


def entries(camera: Camera, sub: SubImager, numbers: FloatArray, pairs: int | None = None) -> sparse.csr_array:
    """Return H of a sub-imager: (its pixels, N).

    pairs : of displacements that represent the disk; None: as many as H needs
    Raises InputError if the distortion folds the image.
    """
    k1, k2 = float(numbers[K1]), coefficients(sub)[1]
    optics = LensOptics(distortion=(k1, k2) if k1 or k2 else None)
    alone = replace(sub, type=replace(sub.type, optics=optics))
    pose = pose_of(sub, misalignment(camera, sub, numbers))
    blur = float(numbers[BLUR])
    if blur == 0:
        return sub_matrix(camera, alone, pose)
    moves = blur * camera.target_pitch * disk(pairs or (FEW if blur <= WIDE else MANY))
    # A ray that is displaced by (x, y) meets the texel that a straight one would meet on a grid displaced back.
    moved = (replace(pose, lens=(pose.lens[0] - x, pose.lens[1] - y)) for x, y in moves.tolist())
    total = sparse.csr_array((sub.type.pixels[0] * sub.type.pixels[1], camera.unknowns))
    for displaced in moved:
        total = total + sub_matrix(camera, alone, displaced)
    return sparse.csr_array(total / len(moves))


@cache
def disk(pairs: int) -> FloatArray:
    """Return points of a uniform disk of diameter 1, and their opposites, with exact second moments: (2 pairs, 2).

    Equal areas along a spiral that turns by the golden angle (Vogel 1979, Mathematical Biosciences 44, 179).
    """
    number = np.arange(pairs)
    radius, angle = np.sqrt((number + 0.5) / pairs) / 2, GOLDEN * number
    half = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate([half, -half])
    values, axes = np.linalg.eigh(points.T @ points / len(points))
    return points @ (axes / np.sqrt(values)) @ axes.T / 4


def scales(camera: Camera, sub: SubImager) -> FloatArray:
    """Return the changes of the parameters that move the edge of a view by about a pixel of f."""
    half = float(sub.type.ratio) * hypot(*sub.type.pixels) / 2
    aside = hypot(sub.lens[0] - sub.patch[0], sub.lens[1] - sub.patch[1]) * camera.distance / sub.depth
    furthest = half + aside / camera.target_pitch
    corner = camera.half_diagonal / camera.target_pitch
    return np.array([1.0, 1.0, 1 / half, 1 / half, corner**2 / furthest**3, 1.0])
