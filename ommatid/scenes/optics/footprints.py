"""H of distorted or misaligned pinholes, by exact overlap of areas.

A texel's image on the sensor has four edges, and each is a rational curve: distortion maps a straight line of the
target to a polynomial of degree 5, and a misaligned patch shows it in perspective. Entry (i, j) of H is the share of
the area of sensor pixel i that the image of texel j covers. Nothing is sampled: cuts are roots of polynomials, and the
integrals along the edges are Gauss's, exact except for the perspective of a tilted patch within one texel, where the
error is below rounding. A lens with an aperture is replaced by its centre, which is right for a target in focus.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import cast

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.processors import processors

from ..camera import Camera
from ..lens_type import SubImager
from ..pose import Pose, corner_offset
from .distortion import coefficients, field

LEAST_SHARE = 1e-13  # smaller shares are rounding errors where edges of texels and of pixels coincide


def sub_matrix(camera: Camera, sub: SubImager, pose: Pose) -> sparse.csr_array:
    """H of one sub-imager: (its pixels, N), with entries accurate to about 1e-13.

    Raises InputError if its distortion folds the image, ValueError if its lens has surfaces.
    """
    from .footprint_kernels import shares  # pyright: ignore[reportUnknownVariableType]

    field(camera, sub, pose)
    if sub.type.optics.surfaces is not None:
        raise ValueError(f"lens type {sub.type.name} has surfaces, expected a pinhole or a thin lens")
    rows, columns = sub.type.pixels
    x = (camera.columns / 2 - np.arange(camera.columns + 1)) * camera.target_pitch - pose.lens[0]
    y = (camera.rows / 2 - np.arange(camera.rows + 1)) * camera.target_pitch - pose.lens[1]
    k1, k2 = coefficients(sub)
    project = _from_tangents(camera, sub, pose)
    project[:, :2] *= camera.half_diagonal / camera.distance  # tangents in units of r
    edges = x / camera.half_diagonal, y / camera.half_diagonal
    entries = shares(*edges, k1, k2, project, (columns, rows), LEAST_SHARE)
    pixels, texels, values = cast(tuple[IntArray, IntArray, FloatArray], entries)
    return sparse.csr_array((values, (pixels, texels)), shape=(rows * columns, camera.unknowns))


def matrix(camera: Camera, poses: tuple[Pose, ...]) -> sparse.csr_array:
    """H of all sub-imagers, with poses in the order of measurements: (M, N). Raises as `sub_matrix` does."""
    with ThreadPoolExecutor(processors()) as threads:
        parts = list(threads.map(partial(sub_matrix, camera), camera.sub_imagers, poses))
    return sparse.csr_array(sparse.vstack(parts, format="csr"))


def _from_tangents(camera: Camera, sub: SubImager, pose: Pose) -> FloatArray:
    """The (3, 3) matrix from (image tangents, 1) to (U W, V W, W), with U and V in pixels from the patch's corner."""
    left, top = corner_offset(camera, sub)
    to_pixels = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, camera.pixel_pitch]]) / camera.pixel_pitch
    return to_pixels @ np.linalg.inv(np.column_stack([pose.axes, pose.middle])) * pose.middle[2]
