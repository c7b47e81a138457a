"""A whole frame of any size: a camera with three lens types, and its measurements of an image drawn from the prior.

Lens types have magnifications 1/3, 1/5 and 1/4 and one sub-imager per sub-pixel shift, so that each type measures every
box of m x m pixels; f0 = 127.5, P0 = 5461.25 and noise of variance 1e-2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import linalg, sparse

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY, FrameSystem, Solution
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import Scene, parse
from ommatid.simulate.ideal import ideal_matrix

from ..frames import frame_system, observed

WIDTHS = (3, 5, 4)
MEAN, VARIANCE, NOISE = 127.5, 5461.25, 1e-2
SMALL = 59  # like 539 one less than a multiple of 60, so that all types see the whole frame and borders are alike


@dataclass(frozen=True)
class Whole:
    """A camera, an image drawn from the prior, (N,), and its measurements, (M,)."""

    camera: Camera
    image: FloatArray
    readings: FloatArray

    @staticmethod
    def drawn(size: int, seed: int = 0) -> Whole:
        """Draw a frame of size x size pixels."""
        camera, rng = whole_camera(size), np.random.default_rng(seed)
        image = rng.normal(MEAN, VARIANCE**0.5, camera.unknowns)
        readings = observed(camera).forward(image)
        readings += rng.normal(0, NOISE**0.5, readings.size)
        return Whole(camera, image, readings)

    @property
    def residual(self) -> FloatArray:
        """g - H f0, (M,). All footprints are inside the frame, so H f0 is f0 everywhere."""
        return self.readings - MEAN

    def frame(self) -> FrameSystem:
        """Return the frame's solver without any preparation."""
        weights = np.broadcast_to(1 / NOISE, self.camera.measurements)
        return frame_system(self.camera, weights, VARIANCE)

    def estimate(self, accuracy: float = ACCURACY) -> Solution:
        """Return f^ - f0, computed without preparation."""
        frame = self.frame()
        return frame.solve(frame.right_hand_side(self.residual), accuracy)


def whole_camera(size: int) -> Camera:
    """Return the camera of a target of size x size pixels."""
    return derive(whole_scene(size))


def whole_scene(size: int) -> Scene:
    """Return the scene of a target of size x size pixels."""
    lenses = [
        {"name": "ABC"[index], "magnification": f"1/{width}", "array": [width, width], "pixels": "fit"}
        for index, width in enumerate(WIDTHS)
    ]
    target = {
        "image": "photo:camera",
        "origin": [0, 0],
        "shape": [size, size],
        "pixel_pitch": "1 mm",
        "distance": "1 m",
    }
    camera = {"pixel_pitch": "6 um", "lens_pitch": "50 mm", "lens": lenses}
    return parse({"target": target, "camera": camera}, Path("whole.toml"))


@cache
def compile_all() -> None:
    """Load compiled functions and start threads, which must not be timed."""
    Whole.drawn(SMALL).estimate()


def deviations(size: int) -> FloatArray:
    """Return the posterior standard deviations of a frame of 60 k - 1 pixels a side, (size, size).

    They are those of a small frame with the same border, whose central pixel, 29 pixels from it, represents all others.
    """
    matrix = ideal_matrix(whole_camera(SMALL))
    precision = (matrix.T @ matrix).toarray() / NOISE
    precision[np.diag_indices_from(precision)] += 1 / VARIANCE
    root = linalg.solve_triangular(linalg.cholesky(precision, lower=True), np.eye(precision.shape[0]), lower=True)
    small = np.sqrt(np.square(root).sum(axis=0)).reshape(SMALL, SMALL)
    index, middle = np.arange(size), SMALL // 2
    folded = np.where(index < size // 2, np.minimum(index, middle), np.maximum(index - size + SMALL, middle))
    return small[np.ix_(folded, folded)]


def stored(camera: Camera) -> sparse.csr_array:
    """Return H, (M, N), with the 32-bit indices for which SciPy's products are fastest."""
    matrix = ideal_matrix(camera)
    indices = (matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32))
    return sparse.csr_array((matrix.data, *indices), shape=matrix.shape)
