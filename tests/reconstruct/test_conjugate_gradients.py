"""Conjugate gradients against dense solutions, and their bound against the actual error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft, linalg

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem, Solution
from ommatid.reconstruct.prior import spectrum_of
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses
from ..frames import FITTED, P0, blurred, frame_camera, frame_system, precision, wide

TWO: Lenses = FITTED[:2]


def ideal_system(shape: tuple[int, int], weight: float, lenses: Lenses = FITTED) -> FrameSystem:
    camera = frame_camera(shape, lenses)
    return frame_system(camera, np.full(camera.measurements, weight))


def largest_error(solution: Solution, expected: FloatArray, covariance: FloatArray) -> float:
    """Largest error of a pixel in its posterior standard deviations."""
    return float(np.max(np.abs(solution.image - expected) / np.sqrt(np.diagonal(covariance))))


@pytest.mark.parametrize(
    ("shape", "noises", "lenses"),
    [
        ((39, 35), (1e-2,), FITTED),
        ((39, 35), (1e-2,), TWO),
        pytest.param((64, 47), (1e-6, 1e-2, 10.0), FITTED, marks=pytest.mark.slow),
        pytest.param((59, 59), (1e-6, 1e-2, 10.0), TWO, marks=pytest.mark.slow),
    ],
)
def test_the_error_of_every_pixel_is_below_the_bound(
    shape: tuple[int, int], noises: tuple[float, ...], lenses: Lenses
) -> None:
    """With and without a null space, with and without pixels outside the field of some lens types."""
    for noise in noises:
        system = ideal_system(shape, 1 / noise, lenses)
        matrix, rng = ideal_matrix(frame_camera(shape, lenses)), np.random.default_rng(3)
        dense = precision(matrix, system.weights, 1 / P0)
        covariance = linalg.inv(dense)
        truth = rng.normal(0, P0**0.5, system.observation.unknowns)
        right = system.right_hand_side(matrix @ truth + rng.normal(0, noise**0.5, system.observation.measurements))
        expected = linalg.solve(dense, right, assume_a="pos")
        rounding = 1e-4 if noise < 1e-5 else 0.0  # of the dense solution: its condition is P0 / noise = 5e9
        for accuracy in (0.3, 0.01):
            solution = system.solve(right, accuracy)
            assert largest_error(solution, expected, covariance) <= solution.bound + rounding
            assert solution.bound <= accuracy


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_bound_holds_for_uneven_h_and_noise(seed: int) -> None:
    """H with errors, noise over two decades and dead pixels take many steps, and the bound holds."""
    model, _ = blurred(wide((41, 38)), 0.005, seed)
    rng = np.random.default_rng(seed)
    weights = 10 ** rng.uniform(0, 2, model.measurements)
    weights[rng.choice(model.measurements, 100, replace=False)] = 0.0
    system = frame_system(model.camera, weights, observation=model.observation)
    dense = precision(model.matrix, weights, 1 / P0)
    right = system.right_hand_side(model.forward(rng.normal(0, P0**0.5, model.unknowns)))
    solution = system.solve(right)
    expected = linalg.solve(dense, right, assume_a="pos")
    assert solution.steps > 10
    assert largest_error(solution, expected, linalg.inv(dense)) <= solution.bound <= 0.01


@pytest.mark.parametrize(
    "table",
    [
        PriorTable(kind="exponential", variance=2000.0, correlation_length="8 mm"),  # type: ignore[arg-type]
        PriorTable(kind="power", variance=2000.0),
    ],
    ids=["exponential", "power"],
)
def test_a_prior_that_is_diagonal_under_the_cosine_transform(table: PriorTable) -> None:
    shape = (33, 30)
    camera = frame_camera(shape)
    spectrum = np.asarray(spectrum_of(table, shape, 1.0))
    system = frame_system(camera, np.full(camera.measurements, 100.0), spectrum)
    waves = np.kron(*(np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape))
    prior = waves.T @ ((1 / spectrum.ravel())[:, None] * waves)
    dense = precision(ideal_matrix(camera), system.weights, 0.0) + prior
    rng = np.random.default_rng(0)
    image = rng.normal(size=camera.unknowns)
    rounding = 1e-12 * np.abs(prior).max()
    np.testing.assert_allclose(system.apply_prior_precision(image), prior @ image, rtol=1e-9, atol=rounding)
    right = system.right_hand_side(system.observation.forward(rng.normal(0, 40, camera.unknowns)))
    solution = system.solve(right)
    expected = linalg.solve(dense, right, assume_a="pos")
    assert largest_error(solution, expected, linalg.inv(dense)) <= solution.bound <= 0.01


def test_an_accuracy_that_is_not_reached_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.reconstruct.frame.conjugate_gradients.MAX_STEPS", 3)
    system = ideal_system((60, 55), 1e4, TWO)
    with pytest.raises(InputError, match=r"after 3 steps, expected 0\.01; set estimator\.method = 'tiles'"):
        system.solve(np.random.default_rng(0).normal(size=system.observation.unknowns))
