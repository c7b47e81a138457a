"""The approximate inverse of a frame's precision: against dense linear algebra, and by the steps that it takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY, Refined
from ommatid.reconstruct.prior import spectrum_of
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.observation import Observation
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses
from ..frames import FITTED, P0, diffracting, frame_camera, frame_system, observed, precision
from ..scenes.test_kernels import CAMERA, smooth_kernels

ODD: Lenses = (("2/7", [4, 4], "fit"), ("1/4", [3, 4], "fit"), ("1/3", [3, 3], "fit"))
RATIOS: Lenses = (("2/7", [4, 4], "fit"), ("3/8", [3, 3], "fit"), ("1/4", [4, 4], "fit"))


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(frame_camera((36, 31)), id="boxes"),
        pytest.param(diffracting((33, 36)), id="kernels", marks=pytest.mark.slow),
    ],
)
def test_it_is_symmetric_and_nearly_the_inverse(camera: Camera) -> None:
    """Eigenvalues of P K are within a sixth of 1 but for a few, at corners that some lens types do not see."""
    preconditioner = frame_system(camera, np.full(camera.measurements, 100.0)).preconditioner
    dense = precision(ideal_matrix(camera), np.full(camera.measurements, 100.0), 1 / P0)
    units = np.eye(camera.unknowns)
    inverse = np.array([preconditioner.solve(unit.reshape(camera.shape)).ravel() for unit in units])
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-10 * np.abs(inverse).max())
    root = linalg.cholesky(dense, lower=True)
    values = linalg.eigvalsh(root.T @ inverse @ root)
    assert values.min() > 0
    assert values.max() < 2.5
    low, middle, high = np.quantile(values, [0.02, 0.5, 0.98])
    assert low > 0.85
    assert abs(middle - 1) < 1e-4
    assert high < 1.15


def steps(camera: Camera, noise: float | FloatArray, prior: float | FloatArray = P0) -> int:
    """Steps to a hundredth of a standard deviation in every pixel."""
    weights = np.broadcast_to(1 / np.asarray(noise), camera.measurements)
    system, rng = frame_system(camera, weights, prior), np.random.default_rng(0)
    readings = system.observation.forward(rng.normal(0, P0**0.5, camera.unknowns))
    return system.solve(system.right_hand_side(readings + rng.normal(size=readings.size) / np.sqrt(weights))).steps


@pytest.mark.parametrize("noise", [1e-3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_steps_with_a_cheaper_h_solve_for_the_exact_one(noise: float) -> None:
    """Fewer than without them, as accurate by the bound, and where noise is so small that what H leaves out matters."""
    exact = Observation(CAMERA.shape, tuple(smooth_kernels(index) for index in range(len(CAMERA.types))))
    image = np.random.default_rng(2).normal(0, P0**0.5, CAMERA.unknowns)
    weights = np.full(CAMERA.measurements, 1 / noise)
    system = frame_system(CAMERA, weights, observation=exact)
    dense = precision(exact.to_sparse(), weights, 1 / P0)
    nested = replace(system, similar=Refined.of(system, system.preconditioner))
    solution, plain = (each.solve(dense @ image) for each in (nested, system))
    assert isinstance(nested.similar, Refined)
    assert solution.steps < 0.7 * plain.steps
    deviations = np.sqrt(np.diagonal(np.linalg.inv(dense)))
    assert np.abs((solution.image - image) / deviations).max() <= solution.bound <= ACCURACY
    designed = frame_system(CAMERA, np.full(CAMERA.measurements, 1.0))
    assert Refined.of(designed, designed.preconditioner) is designed.preconditioner


def test_few_steps_whatever_the_camera() -> None:
    """Measured 7, 25, 24 and 40: more where edges lie outside the field of some lens types, whatever the size."""
    assert steps(frame_camera((119, 119)), 1e-2) <= 10
    assert steps(frame_camera((70, 77)), 1e-2) <= 35
    assert steps(diffracting((80, 77)), 1e-2) <= 35
    assert steps(frame_camera((83, 80), ODD), 1e-2) <= 60


@pytest.mark.parametrize("kind", ["exponential", "power"])
def test_few_steps_with_correlated_pixels(kind: str) -> None:
    camera = frame_camera((70, 77))
    length = "8 mm" if kind == "exponential" else None
    table = PriorTable(kind=kind, variance=2000.0, correlation_length=length)  # type: ignore[arg-type]
    assert steps(camera, 1e-2, np.asarray(spectrum_of(table, camera.shape, 1.0))) <= 27


def test_behind_odd_ratios_the_better_one_of_mean_power_and_mean_kernels_serves() -> None:
    """Measured 22 and 104; mean power alone takes 37 with much noise, and mean kernels 127 with little."""
    camera = frame_camera((70, 77), RATIOS)
    spectrum = np.asarray(spectrum_of(PriorTable(kind="power", variance=2000.0), camera.shape, 1.0))
    assert steps(camera, 1.0, spectrum) <= 27
    assert steps(camera, 1e-2, spectrum) <= 112


def test_uneven_noise_is_scaled_where_that_takes_fewer_steps() -> None:
    """Noise that varies smoothly over two decades: by the mean weight alone it takes several times as many steps."""
    camera = frame_camera((119, 119))
    place = observed(camera).forward(np.broadcast_to(np.linspace(-3, -1, 119), camera.shape))
    assert steps(camera, 10.0**place) <= 15


def test_two_types_take_more_steps_and_arrive() -> None:
    assert steps(frame_camera((70, 77), FITTED[:2]), 1e-2) <= 140
