"""H of a perfect camera in closed form: what share of a sensor pixel's footprint each pixel of f covers.

A footprint is a rectangle of m x m pixels of f, so H is a Kronecker product of two overlaps along one axis for
every sub-imager (Wood et al., section 2). Overlaps are computed in whole numbers and are exact for any ratio.
"""

from __future__ import annotations

from fractions import Fraction
from math import lcm

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scenes.camera import Camera, SubImager
from scenes.model import Model
from scenes.scene import Scene


def overlap(ratio: Fraction, pixels: int, start: Fraction, size: int) -> sparse.csr_array:
    """Shares, (pixels, size), of `size` unit cells in `pixels` intervals of length `ratio` that begin at `start`."""
    unit = lcm(ratio.denominator, start.denominator)
    length = int(ratio * unit)
    lower = int(start * unit) + length * np.arange(pixels, dtype=np.int64)
    width = -(-length // unit) + 1  # cells that an interval can touch
    cells = (lower // unit)[:, None] + np.arange(width)
    shared = np.minimum(lower[:, None] + length, (cells + 1) * unit) - np.maximum(lower[:, None], cells * unit)
    touched = (shared > 0) & (cells >= 0) & (cells < size)
    rows = np.broadcast_to(np.arange(pixels)[:, None], cells.shape)[touched]
    return sparse.csr_array((shared[touched] / length, (rows, cells[touched])), shape=(pixels, size))


def sub_matrix(camera: Camera, sub: SubImager) -> sparse.csr_array:
    """H of one sub-imager: (its pixels, N)."""
    down = overlap(sub.type.ratio, sub.type.pixels[0], sub.window[0], camera.rows)
    across = overlap(sub.type.ratio, sub.type.pixels[1], sub.window[1], camera.columns)
    return sparse.csr_array(sparse.kron(down, across, format="csr"))


def ideal_matrix(camera: Camera) -> sparse.csr_array:
    """H of all sub-imagers: (M, N)."""
    return sparse.csr_array(sparse.vstack([sub_matrix(camera, sub) for sub in camera.sub_imagers], format="csr"))


def ideal_model(scene: Scene, camera: Camera) -> Model:
    """The ideal H as a model without uncertainty."""
    matrix = ideal_matrix(camera)
    none: NDArray[np.float32] = np.zeros((0, matrix.nnz), dtype=np.float32)
    return Model(scene, camera, matrix, np.zeros(matrix.nnz), none, {"method": "ideal"})
