"""H of pinholes that distort or stand misaligned, by exact overlap of areas.

A texel's image on the sensor has four edges, and each is a rational curve: distortion makes a polynomial of degree 5
of a straight line of the target, and a misaligned patch sees it in perspective. Entry (i, j) of H is the share of the
area of sensor pixel i on which the image of texel j lies. Nothing is sampled: cuts are roots of polynomials, and the
integrals along the edges are Gauss's, exact but for a tilted patch's perspective within one texel, and there beyond
rounding. Lenses of an aperture count as their centre: this is what they show of a target in focus.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.processors import processors

from ..camera import Camera
from ..lens_type import SubImager
from ..pose import Pose, corner_offset
from .distortion import coefficients, field, undistort

Range = tuple[NDArray[np.int64], NDArray[np.int64]]

LEAST_SHARE = 1e-13  # less is rounding, where edges of texels and of pixels coincide
STEPS = 8  # along a pixel's side, for bounds


def sub_matrix(camera: Camera, sub: SubImager, pose: Pose) -> sparse.csr_array:
    """H of one sub-imager: (its pixels, N), entries right to about 1e-13.

    Raises InputError if its distortion folds the image, ValueError if its lens is given by surfaces.
    """
    from .footprint_kernels import shares  # pyright: ignore[reportUnknownVariableType]

    field(camera, sub, pose)
    if sub.type.optics.surfaces is not None:
        raise ValueError(f"lens type {sub.type.name} is given by surfaces, expected a pinhole or a thin lens")
    rows, columns = sub.type.pixels
    x = (camera.columns / 2 - np.arange(camera.columns + 1)) * camera.target_pitch - pose.lens[0]
    y = (camera.rows / 2 - np.arange(camera.rows + 1)) * camera.target_pitch - pose.lens[1]
    k1, k2 = coefficients(sub)
    project = _from_tangents(camera, sub, pose)
    project[:, :2] *= camera.half_diagonal / camera.distance  # tangents in units of r
    places = x / camera.half_diagonal, y / camera.half_diagonal
    found = shares(*places, k1, k2, project, (columns, rows), LEAST_SHARE)
    pixels, texels, values = cast(tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]], found)
    return sparse.csr_array((values, (pixels, texels)), shape=(rows * columns, camera.unknowns))


def matrix(camera: Camera, poses: tuple[Pose, ...]) -> sparse.csr_array:
    """H of all sub-imagers, whose poses are in the order of measurements: (M, N). Raises as `sub_matrix` does."""
    with ThreadPoolExecutor(processors()) as threads:
        parts = list(threads.map(partial(sub_matrix, camera), camera.sub_imagers, poses))
    return sparse.csr_array(sparse.vstack(parts, format="csr"))


def footprint(
    camera: Camera, sub: SubImager, pose: Pose, u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Row and column of f, as real numbers, that the chief rays of points (u, v) of the patch come from.

    Raises InputError if the distortion folds the image.
    """
    limit = field(camera, sub, pose)
    point = [at + along[0] * u + along[1] * v for at, along in zip(pose.middle, pose.axes, strict=True)]
    image = point[0] / point[2], point[1] / point[2]
    x, y = undistort(*image, *coefficients(sub), camera.distance / camera.half_diagonal, limit)
    row = camera.rows / 2 - (pose.lens[1] + y * camera.distance) / camera.target_pitch
    return row, camera.columns / 2 - (pose.lens[0] + x * camera.distance) / camera.target_pitch


def reach(camera: Camera, sub: SubImager, pose: Pose) -> tuple[Range, Range]:
    """First and last + 1 row, and first and last + 1 column of f, that each pixel's chief rays can come from.

    Arrays of (pixels,). Bounds, not the closest ones; they may lie outside the target. Raises as `footprint` does.
    """
    rows, columns = sub.type.pixels
    left, top = corner_offset(camera, sub)
    side = np.linspace(0.0, 1.0, STEPS + 1)
    none, whole = np.zeros_like(side), np.ones_like(side)
    du = np.concatenate([side, whole, side[::-1], none])  # once around a pixel
    dv = np.concatenate([none, side, whole, side[::-1]])
    i, j = np.divmod(np.arange(rows * columns), columns)
    u, v = left + (j[:, None] + du) * camera.pixel_pitch, top + (i[:, None] + dv) * camera.pixel_pitch
    row, column = footprint(camera, sub, pose, u, v)
    return _range(row), _range(column)


def _range(at: NDArray[np.float64]) -> Range:
    """Whole numbers around values at `STEPS` + 1 points of each of four smooth sides, (pixels, points)."""
    sides = at.reshape(at.shape[0], 4, -1)
    # Between points a curve rises above both by at most 1/8 of its second difference there; twice that is added.
    bulge = np.abs(np.diff(sides, 2, axis=2)).max(axis=(1, 2)) / 4 + 1e-9
    return np.floor(at.min(axis=1) - bulge).astype(np.int64), np.ceil(at.max(axis=1) + bulge).astype(np.int64)


def _from_tangents(camera: Camera, sub: SubImager, pose: Pose) -> NDArray[np.float64]:
    """(3, 3) that makes (U W, V W, W), U and V in pixels from the patch's corner, of image tangents and 1."""
    left, top = corner_offset(camera, sub)
    to_pixels = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, camera.pixel_pitch]]) / camera.pixel_pitch
    return to_pixels @ np.linalg.inv(np.column_stack([pose.axes, pose.middle])) * pose.middle[2]
