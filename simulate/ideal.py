"""H of a perfect camera in closed form: what share of a sensor pixel's footprint each pixel of f covers.

A footprint is a rectangle of m x m pixels of f, so H is a Kronecker product of two overlaps along one axis for
every sub-imager (Wood et al., section 2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scenes.boxes import Boxes, overlap
from scenes.camera import Camera, SubImager
from scenes.model import Model
from scenes.scene import Scene

MOST_STORED = 2**24  # entries of H; more follow from the scene each time


def sub_matrix(camera: Camera, sub: SubImager) -> sparse.csr_array:
    """H of one sub-imager: (its pixels, N)."""
    down = overlap(sub.type.ratio, sub.type.pixels[0], sub.window[0], camera.rows)
    across = overlap(sub.type.ratio, sub.type.pixels[1], sub.window[1], camera.columns)
    return sparse.csr_array(sparse.kron(down, across, format="csr"))


def ideal_matrix(camera: Camera) -> sparse.csr_array:
    """H of all sub-imagers: (M, N)."""
    return sparse.csr_array(sparse.vstack([sub_matrix(camera, sub) for sub in camera.sub_imagers], format="csr"))


def ideal_model(scene: Scene, camera: Camera) -> Model:
    """The ideal H as a model without uncertainty; stored only while it is small."""
    matrix = ideal_matrix(camera) if Boxes(camera).entries <= MOST_STORED else None
    entries = 0 if matrix is None else int(matrix.nnz)
    none: NDArray[np.float32] = np.zeros((0, entries), dtype=np.float32)
    return Model(scene, camera, matrix, np.zeros(entries), none, {"method": "ideal"})
