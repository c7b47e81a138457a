"""A whole frame to estimate: a camera of three lens types, of any size, and what it reads of an image from the prior.

Lens types with magnifications 1/3, 1/5 and 1/4 and as many sub-imagers as these make sub-pixel shifts, so that each
type sees every box of m x m pixels; f0 = 127.5, P0 = 5461.25 and noise of variance 1e-2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY, FrameSystem, Solution
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.boxes import BoxFootprints
from ommatid.scenes.scene import Scene, parse
from ommatid.simulate.ideal import ideal_matrix

Vector = NDArray[np.float64]
Image = NDArray[np.float64]

WIDTHS = (3, 5, 4)
MEAN, VARIANCE, NOISE = 127.5, 5461.25, 1e-2
SMALL = 59  # like 539 one less than a multiple of 60, so that the border is the same: all types see all of the frame
WAVES = 1024  # of a grid of frequencies along one axis, over which the interior's variance is averaged


@dataclass(frozen=True)
class Whole:
    """A camera, an image (N,) drawn from the prior, and what the camera reads of it, (M,)."""

    camera: Camera
    image: Vector
    readings: Vector

    @staticmethod
    def drawn(size: int, seed: int = 0) -> Whole:
        """A frame of size x size pixels."""
        camera, rng = whole_camera(size), np.random.default_rng(seed)
        image = rng.normal(MEAN, VARIANCE**0.5, camera.unknowns)
        readings = BoxFootprints(camera).forward(image)
        readings += rng.normal(0, NOISE**0.5, readings.size)
        return Whole(camera, image, readings)

    @property
    def unexpected(self) -> Vector:
        """g - H f0: (M,). What every type sees is inside the frame, so H f0 is f0 everywhere."""
        return self.readings - MEAN

    def frame(self) -> FrameSystem:
        """Its solver, with nothing prepared yet."""
        weights = np.broadcast_to(1 / NOISE, self.camera.measurements)
        return FrameSystem(self.camera, BoxFootprints(self.camera), weights, 1 / VARIANCE)

    def estimate(self, accuracy: float = ACCURACY) -> Solution:
        """f^ - f0, from nothing prepared."""
        frame = self.frame()
        return frame.solve(frame.right_hand_side(self.unexpected), accuracy)


def whole_camera(size: int) -> Camera:
    """The camera of a target of size x size pixels."""
    return derive(whole_scene(size))


def whole_scene(size: int) -> Scene:
    """Its scene."""
    lenses = [
        {"name": "ABC"[place], "magnification": f"1/{width}", "array": [width, width], "pixels": "fit"}
        for place, width in enumerate(WIDTHS)
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
    """Load what is compiled, and start the threads that are kept, so that nothing of it is timed."""
    Whole.drawn(SMALL).estimate()


def deviations(size: int) -> Image:
    """Posterior standard deviation of every pixel of a frame of 60 k - 1 pixels: (size, size).

    From all of C of a small frame with the same border; 29 pixels from there the middle one is that of any.
    """
    matrix = ideal_matrix(whole_camera(SMALL))
    precision = (matrix.T @ matrix).toarray() / NOISE
    precision[np.diag_indices_from(precision)] += 1 / VARIANCE
    root = linalg.solve_triangular(linalg.cholesky(precision, lower=True), np.eye(precision.shape[0]), lower=True)
    small = np.sqrt(np.square(root).sum(axis=0)).reshape(SMALL, SMALL)
    places, middle = np.arange(size), SMALL // 2
    folded = np.where(places < size // 2, np.minimum(places, middle), np.maximum(places - size + SMALL, middle))
    return small[np.ix_(folded, folded)]


@cache
def predicted() -> tuple[float, float]:
    """Posterior variance far from the border, and the standard error of a mean squared error, times sqrt(pixels).

    There K is a convolution whose transfer function is the sum over types of the squared one of a mean over m x m.
    """
    angle = np.pi * (np.arange(WAVES) + 0.5) / WAVES
    squared = [np.square(np.sin(width * angle / 2) / (width * np.sin(angle / 2))) for width in WIDTHS]
    covariance = 1 / (sum(np.outer(part, part) for part in squared) / NOISE + 1 / VARIANCE)
    return float(covariance.mean()), float((2 * np.square(covariance).mean()) ** 0.5)


def stored(camera: Camera) -> sparse.csr_array:
    """H, (M, N), with the short indices that make SciPy's products fastest."""
    matrix = ideal_matrix(camera)
    short = (matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32))
    return sparse.csr_array((matrix.data, *short), shape=matrix.shape)
