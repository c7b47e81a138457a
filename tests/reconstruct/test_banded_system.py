"""Frames whose lens types leave a null space, or are other arrays: against the dense problem, and what tiles cost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.reconstruct.frame.readings import leaves_null_space
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import Lenses, camera
from ..examples import scene as described

ONE: Lenses = (("1/3", [3, 3], "fit"),)
TWO: Lenses = (*ONE, ("1/5", [5, 5], "fit"))
ODD: Lenses = (*ONE, ("1/4", [3, 5], "fit"))
FRACTION: Lenses = (*ONE, ("2/7", [4, 4], "fit"))
THREE: Lenses = (*TWO, ("1/4", [4, 4], "fit"))
NOISE = 1e-2


def recorded(scene: Scene, rng: np.random.Generator, used: bool = True) -> tuple[Stack, FloatArray]:
    camera = derive(scene)
    image = 127.5 + 5461.25**0.5 * rng.normal(size=camera.unknowns)
    values = ideal_model(scene, camera).forward(image) + rng.normal(0, NOISE**0.5, camera.measurements)
    if not used:
        values[::23] = np.nan
    return Stack(scene, camera, values, np.zeros(values.size), {}), image


def restored(stack: Stack, image: FloatArray, method: str) -> Reconstruction:
    estimator = stack.scene.estimator.model_copy(update={"method": method})
    scene = stack.scene.model_copy(update={"estimator": estimator})
    return restore(replace(stack, scene=scene), ideal_model(scene, stack.camera), image)


@pytest.mark.parametrize(("shape", "lenses"), [((24, 31), ONE), ((31, 24), TWO), ((25, 25), ODD), ((27, 25), FRACTION)])
def test_a_frame_is_the_dense_problem(shape: tuple[int, int], lenses: Lenses) -> None:
    scene = described(shape, lenses, noise={"variance": NOISE})
    stack, image = recorded(scene, np.random.default_rng(0), used=lenses in (ONE, ODD))
    dense, frame = restored(stack, image, "auto"), restored(stack, image, "frame")
    np.testing.assert_allclose(frame.estimate, dense.estimate, atol=1e-6 * 5461.25**0.5)
    # Its parts are differences of inverses, at a step of 1e-4.
    np.testing.assert_allclose(frame.expected.variance, dense.expected.variance, rtol=2e-4)
    np.testing.assert_allclose(frame.expected.resolved, dense.expected.resolved, atol=1e-6)
    assert frame.solver.variance_bound < 1e-6
    assert frame.interval is not None
    assert dense.interval is not None
    assert frame.interval.mse == pytest.approx(dense.interval.mse, rel=1e-3)


@pytest.mark.parametrize(
    ("lenses", "side", "method"), [(TWO, 99, "frame"), (ODD, 99, "frame"), (TWO, 499, "tiles"), (THREE, 499, "frame")]
)
def test_large_frames_with_a_null_space_are_factorised_and_larger_ones_tiled(
    lenses: Lenses, side: int, method: str
) -> None:
    data = described((side, side), (("1/3", [1, 1], [3, 3]),), noise={"variance": NOISE}).plain()
    lens = [
        {"name": f"L{number}", "magnification": ratio, "array": array, "pixels": pixels}
        for number, (ratio, array, pixels) in enumerate(lenses)
    ]
    scene = parse({**data, "camera": {**data["camera"], "lens_pitch": "2 mm", "lens": lens}}, Path("test.toml"))
    assert choose_method(scene, derive(scene), exact=True).method == method


@pytest.mark.parametrize(("lenses", "leaves"), [(ONE, True), (TWO, True), (ODD, True), (THREE, False)])
def test_a_null_space_of_every_frame(lenses: Lenses, leaves: bool) -> None:
    """By the rank of H of a small frame."""
    seen = camera((59, 59), lenses)
    small = np.linalg.matrix_rank(ideal_matrix(camera((19, 19), lenses)).toarray()) if leaves else 0
    assert leaves_null_space(seen) is leaves
    assert small < 19**2
