"""Conjugate gradients against dense solutions, and the approximate inverse of a frame's precision by its steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import fft, linalg

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY, FrameSystem, Refined, Solution
from ommatid.reconstruct.frame.unseen import with_unseen
from ommatid.reconstruct.prior import spectrum_of
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.observation import Observation
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses, slow
from ..frames import FITTED, P0, blurred, diffracting, frame_camera, frame_system, observed, precision, wide
from ..scenes.test_observation import CAMERA, smooth_kernels

TWO: Lenses = FITTED[:2]


CORRELATED = {
    "exponential": PriorTable.model_validate({"kind": "exponential", "variance": 2000.0, "correlation_length": "8 mm"}),
    "power": PriorTable(kind="power", variance=2000.0),
}


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
        slow((64, 47), (1e-6, 1e-2, 10.0), FITTED),
        slow((59, 59), (1e-6, 1e-2, 10.0), TWO),
    ],
)
def test_errors_of_all_pixels_are_below_the_bound(
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


@pytest.mark.parametrize("seed", [0, slow(1)])
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


@pytest.mark.parametrize("kind", CORRELATED)
def test_a_prior_that_is_diagonal_under_the_cosine_transform(kind: str) -> None:
    camera, shape = frame_camera((33, 30)), (33, 30)
    spectrum = np.asarray(spectrum_of(CORRELATED[kind], shape, 1.0))
    system = frame_system(camera, np.full(camera.measurements, 100.0), spectrum)
    waves = np.kron(*(np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape))
    prior, rng = waves.T @ ((1 / spectrum.ravel())[:, None] * waves), np.random.default_rng(0)
    image, rounding = rng.normal(size=camera.unknowns), 1e-12 * np.abs(prior).max()
    np.testing.assert_allclose(system.apply_prior_precision(image), prior @ image, rtol=1e-9, atol=rounding)
    dense = precision(ideal_matrix(camera), system.weights, 0.0) + prior
    right = system.right_hand_side(system.observation.forward(rng.normal(0, 40, camera.unknowns)))
    solution, expected = system.solve(right), linalg.solve(dense, right, assume_a="pos")
    assert largest_error(solution, expected, linalg.inv(dense)) <= solution.bound <= 0.01


def test_an_accuracy_that_is_not_reached_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.reconstruct.frame.conjugate_gradients.MAX_STEPS", 3)
    system = ideal_system((60, 55), 1e4, TWO)
    with pytest.raises(InputError, match=r"after 3 steps, expected 0\.01; set estimator\.method = 'tiles'"):
        system.solve(np.random.default_rng(0).normal(size=system.observation.unknowns))


# --- the approximate inverse


ODD: Lenses = (("2/7", [4, 4], "fit"), ("1/4", [3, 4], "fit"), ("1/3", [3, 3], "fit"))
RATIOS: Lenses = (("2/7", [4, 4], "fit"), ("3/8", [3, 3], "fit"), ("1/4", [4, 4], "fit"))


@pytest.mark.parametrize(
    "camera", [pytest.param(frame_camera((36, 31)), id="boxes"), slow(diffracting((33, 36)), id="kernels")]
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


@pytest.mark.parametrize("noise", [1e-3, slow(1.0)])
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


@pytest.mark.parametrize("correlated", [True, slow(False)])
def test_a_region_without_readings_is_that_of_the_dense_problem(correlated: bool) -> None:
    """As where all saturate. Without its own part of the preconditioner twice the steps lead nowhere near it."""
    camera, rng = frame_camera((37, 37)), np.random.default_rng(1)
    row, column = np.indices(camera.shape)
    region = (np.hypot(row - 17, column - 19) < 9).astype(np.float64)
    matrix = observed(camera).to_sparse()
    weights = np.where(matrix @ region.ravel() > 0, 0.0, 100.0)
    prior = spectrum_of(CORRELATED["exponential"], camera.shape, camera.target_pitch) if correlated else P0
    system = frame_system(camera, weights, prior)
    hidden = (matrix.T @ weights == 0) & (matrix.T @ np.ones(weights.size) > 0)
    np.testing.assert_array_equal(system.unseen.ravel(), hidden)
    assert hidden.sum() >= region.sum()
    apart = replace(system, similar=with_unseen(system, system.bands))
    white = rng.normal(size=camera.shape) * np.sqrt(prior)
    image = (fft.idctn(white, 2, norm="ortho") if correlated else white).ravel()
    right = system.apply(image)
    solution = apart.solve(right)
    dense = np.array([system.apply(pixel) for pixel in np.eye(camera.unknowns)])
    deviations = np.sqrt(np.diagonal(np.linalg.inv(dense)))
    assert np.abs((solution.image - image) / deviations).max() <= solution.bound <= ACCURACY
    assert replace(system, similar=system.bands).steps(right, 2 * solution.steps)[1] > 100 * ACCURACY


def uneven(camera: Camera) -> FloatArray:
    """Noise that varies smoothly over two decades: by the mean weight alone it takes several times as many steps."""
    return 10.0 ** observed(camera).forward(np.broadcast_to(np.linspace(-3, -1, camera.columns), camera.shape))


@pytest.mark.parametrize(
    ("camera", "noise", "prior", "most"),
    [
        (lambda: frame_camera((119, 119)), 1e-2, None, 10),
        (lambda: frame_camera((70, 77)), 1e-2, None, 35),
        (lambda: diffracting((80, 77)), 1e-2, None, 35),
        (lambda: frame_camera((83, 80), ODD), 1e-2, None, 60),
        (lambda: frame_camera((119, 119)), uneven, None, 15),
        (lambda: frame_camera((70, 77), FITTED[:2]), 1e-2, None, 140),
        *((lambda: frame_camera((70, 77)), 1e-2, prior, 27) for prior in CORRELATED.values()),
        # The better one of mean power and mean kernels: mean power alone takes 37, and mean kernels 127.
        (lambda: frame_camera((70, 77), RATIOS), 1.0, CORRELATED["power"], 27),
        (lambda: frame_camera((70, 77), RATIOS), 1e-2, CORRELATED["power"], 112),
    ],
)
def test_few_steps_whatever_the_camera(camera: Any, noise: Any, prior: PriorTable | None, most: int) -> None:
    """More where edges lie outside the field of some lens types, whatever the size."""
    seen = camera()
    spectrum = P0 if prior is None else np.asarray(spectrum_of(prior, seen.shape, 1.0))
    assert steps(seen, uneven(seen) if noise is uneven else noise, spectrum) <= most
