"""A whole frame of any size: a camera with three lens types, and its measurements of an image drawn from the prior.

Lens types have magnifications 1/3, 1/5 and 1/4 and one sub-imager per sub-pixel shift: pinholes, of which each type
measures every box of m x m pixels, the same with the displaced views that a fitted H has, or thin lenses;
f0 = 127.5, P0 = 5461.25 and noise of variance 1e-2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY, FrameSystem, Solution
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.fitted.fitted_matrix import FittedMatrix, Views, views_as_designed
from ommatid.scenes.fitted.view import COLUMN, ROW
from ommatid.scenes.model import Model, fitted_model
from ommatid.scenes.scene import Scene, parse
from ommatid.simulate.ideal import ideal_model

from ..frames import frame_system

WIDTHS = (3, 5, 4)
MEAN, VARIANCE, NOISE = 127.5, 5461.25, 1e-2
SMALL = 59  # like 539 one less than a multiple of 60, so that all types see the whole frame
APERTURE, SHIFT = "0.4 mm", 0.05  # pixels of f, of each sub-imager's view
KINDS = PINHOLES, FITTED, LENSES = "pinholes, as designed", "pinholes, fitted", "thin lenses of 0.4 mm"


@dataclass(frozen=True)
class Whole:
    """A camera with its H, an image drawn from the prior, (N,), and its measurements, (M,)."""

    scene: Scene
    model: Model
    image: FloatArray
    readings: FloatArray

    @staticmethod
    def drawn(kind: str, size: int, seed: int = 0) -> Whole:
        """Draw a frame of size x size pixels."""
        scene, rng = whole_scene(kind, size), np.random.default_rng(seed)
        camera = derive(scene)
        model = _displaced(scene, camera, rng) if kind == FITTED else ideal_model(scene, camera)
        image = rng.normal(MEAN, VARIANCE**0.5, model.unknowns)
        readings = model.applied.forward(image)
        readings += rng.normal(0, NOISE**0.5, readings.size)
        return Whole(scene, model, image, readings)

    @cached_property
    def residual(self) -> FloatArray:
        """g - H f0, (M,)."""
        return self.readings - MEAN * self.model.applied.forward(np.ones(self.model.unknowns))

    def frame(self) -> FrameSystem:
        """Return the frame's solver without any preparation."""
        weights = np.broadcast_to(1 / NOISE, self.model.measurements)
        return frame_system(self.model.camera, weights, VARIANCE, self.model.applied)

    def estimate(self, accuracy: float = ACCURACY) -> Solution:
        """Return f^ - f0, computed without preparation."""
        frame = self.frame()
        return frame.solve(frame.right_hand_side(self.residual), accuracy)

    @cached_property
    def deviation(self) -> float:
        """Posterior standard deviation of a pixel far from the edges, by transfer functions."""
        bands = self.frame().bands
        return bands.variances(1.0, (1.0,) * len(bands.types))[0] ** 0.5


def whole_scene(kind: str, size: int) -> Scene:
    """Return the scene of a target of size x size pixels."""
    lenses: list[dict[str, object]] = [
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
    if kind == LENSES:
        lenses = [lens | {"aperture": APERTURE} for lens in lenses]
    camera = {"pixel_pitch": "6 um", "lens_pitch": "50 mm", "lens": lenses}
    return parse({"target": target, "camera": camera}, Path("whole.toml"))


def _displaced(scene: Scene, camera: Camera, rng: np.random.Generator) -> Model:
    """Return an H by views that are displaced at random along both axes."""
    views: dict[str, Views] = {}
    for lens_type in camera.types:
        designed = views_as_designed([sub for sub in camera.sub_imagers if sub.type == lens_type])
        numbers = designed.numbers.copy()
        numbers[:, [ROW, COLUMN]] += rng.normal(0, SHIFT, (len(numbers), 2))
        structure = tuple("own" if number in (ROW, COLUMN) else "designed" for number in range(numbers.shape[1]))
        views[lens_type.name] = replace(designed, numbers=numbers, structure=structure)
    return fitted_model(scene, camera, FittedMatrix(camera, views, {}), None, {"method": "transport"})


@cache
def compile_all() -> None:
    """Load compiled functions and start threads, which must not be timed."""
    for kind in KINDS:
        Whole.drawn(kind, SMALL).estimate()


def stored(whole: Whole) -> sparse.csr_array | LinearOperator:
    """Return H, (M, N), with the 32-bit indices for which SciPy's products are fastest; an operator if it is too large.

    Kernels of thin lenses are as wide as the frame's tails: a stored H would take tens of gigabytes.
    """
    observation = whole.model.applied
    if not whole.model.camera.has_box_footprints:
        shape = whole.model.measurements, whole.model.unknowns
        return LinearOperator(shape, observation.forward, observation.adjoint, dtype=np.float64)
    matrix = observation.to_sparse()
    indices = (matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32))
    return sparse.csr_array((matrix.data, *indices), shape=matrix.shape)
