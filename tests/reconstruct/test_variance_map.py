"""Maps of the posterior variance against dense inverses and against exact solutions for single pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft, linalg, sparse

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.frame.error_map import ExactVariances, check_map
from ommatid.reconstruct.frame.sliding import sliding_camera
from ommatid.reconstruct.frame.variance_map import (
    SmallFrames,
    posterior_variance,
    sliding_variance_map,
    small_map,
)
from ommatid.reconstruct.frame.window_variances import pixel_numbers, stencil_variances, stored_stencil
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Observation
from ommatid.simulate.ideal import ideal_matrix

from ..frames import P0, blurred, diffracting, frame_camera, observed, precision, sliding, wide

STATED = 1e-3  # relative accuracy of the maps


@pytest.mark.parametrize(
    ("shape", "noise"),
    [((64, 71), 1e-2), *(pytest.param((119, 119), noise, marks=pytest.mark.slow) for noise in (1e-6, 1e-2, 10.0))],
)
def test_the_map_has_the_stated_accuracy(shape: tuple[int, int], noise: float) -> None:
    """At corners, at edges, near them and in the middle, with and without pixels outside some lens types' field."""
    camera = frame_camera(shape)
    variance = posterior_variance(sliding(camera, (1 / noise,) * 3, 1 / P0))
    system = FrameSystem(observed(camera), np.full(camera.measurements, 1 / noise), 1 / P0)
    rows, columns = shape
    for row, column in (
        *((0, 0), (0, 50), (1, 2), (rows - 1, 5), (rows - 2, columns - 3), (4, 60), (rows // 2, columns - 1)),
        *((17, 40), (19, 19), (20, 55), (22, 24), (rows // 2, columns // 2), (rows // 3, 19), (rows - 21, 33)),
    ):
        unit = np.zeros(camera.unknowns)
        unit[row * columns + column] = 1.0
        exact = system.solve(unit, 1e-6).image[row * columns + column]
        assert variance[row, column] == pytest.approx(exact, rel=STATED), (row, column)


@pytest.mark.parametrize("actual", [(1e-4, 1e-3, 1e-2), (0.01, 0.01, 0.01)])
def test_actual_noise_that_differs_from_the_expected_one(actual: tuple[float, float, float]) -> None:
    """Eq. 5 by finite differences of step 1e-4 against dense matrices, on a frame that strips cover entirely."""
    camera = frame_camera((38, 35))
    system = sliding(camera, (100.0,) * 3, 1 / P0)
    variances = sliding_variance_map(system, actual, posterior_variance)
    matrix = ideal_matrix(camera)
    covariance = linalg.inv(precision(matrix, np.full(camera.measurements, 100.0), 1 / P0))
    noise = np.concatenate(
        [np.full(lens_type.measurements, value) for lens_type, value in zip(camera.types, actual, strict=True)]
    )
    noise_gram = precision(matrix, 1e4 * noise, 0.0)
    missing = np.square(covariance).sum(axis=1) / P0
    expected = missing + np.diagonal(covariance @ noise_gram @ covariance)
    np.testing.assert_allclose(variances.posterior.ravel(), np.diagonal(covariance), rtol=1e-9)
    np.testing.assert_allclose(variances.missing.ravel(), missing, rtol=2e-4)
    np.testing.assert_allclose((variances.missing + variances.noisy).ravel(), expected, rtol=2e-4)


def test_any_h_and_any_noise() -> None:
    """H with errors and noise over a decade, by one sweep, against the dense inverse."""
    shape = (36, 31)
    model, _ = blurred(wide(shape, (("1/4", [2, 3], "fit"), ("1/3", [3, 3], "fit"))), 0.004)
    weights = 10 ** np.random.default_rng(1).uniform(1, 2, model.measurements)
    pixels = pixel_numbers(shape, slice(0, shape[0]), slice(0, shape[1]))
    stencil = stored_stencil(sparse.csc_array(model.matrix), weights, 1 / P0, pixels, model.windowed.reach - 1)
    dense = precision(model.matrix, weights, 1 / P0)
    np.testing.assert_allclose(stencil_variances(stencil).ravel(), np.diagonal(linalg.inv(dense)), rtol=1e-8)


UNEVEN = np.array([[1.0, 0.04, -0.02, -0.1, 0.02, -0.07]])  # a Legendre polynomial over the field


def over_the_field(shape: tuple[int, int]) -> Observation:
    """H of thin lenses which diffract; behind one type the light varies over the field."""
    observation = observed(diffracting(shape))
    parts = [
        replace(part, degree=2, coefficients=UNEVEN, error_coefficients=np.zeros((0, 0, UNEVEN.size)))
        for part in observation.parts[:1]
        if isinstance(part, KernelFootprints)
    ]
    return replace(observation, parts=(*parts, *observation.parts[1:]))


@pytest.mark.parametrize("correlated", [False, True])
def test_a_small_frame_is_the_dense_answer(correlated: bool) -> None:
    """All parts of Eq. 5, of kernels that vary over the field and of actual noise that differs by lens type."""
    observation, ratios = over_the_field((21, 18)), (1.0, 0.5, 3.0)
    spectrum = 1e4 / (1 + np.add.outer(np.arange(21), np.arange(18)) ** 2.0)
    system = sliding_camera(
        observation, diffracting((21, 18)).types, (30.0, 20.0, 10.0), 1 / spectrum if correlated else 1 / P0
    )
    matrices = [part.to_sparse().toarray() for part in observation.parts]
    waves = np.kron(*(fft.dct(np.eye(size), norm="ortho", axis=0) for size in (21, 18)))
    prior = waves.T @ np.diag(1 / spectrum.ravel()) @ waves if correlated else np.eye(378) / P0
    grams = [each.T @ each for each in matrices]
    weighed = [weight * each for weight, each in zip(system.weights, grams, strict=True)]
    covariance = linalg.inv(prior + 0.7 * sum(weighed))
    noise = 0.7 * sum(ratio * each for ratio, each in zip(ratios, weighed, strict=True))
    expected = [covariance, covariance @ prior @ covariance, covariance @ noise @ covariance]
    for found, each in zip(small_map(system, 0.7, ratios), expected, strict=True):
        np.testing.assert_allclose(found.ravel(), np.diagonal(each), rtol=1e-8)


def test_kernels_that_vary_over_the_field() -> None:
    """To 0.5 % of a deviation where the light varies by a quarter, at corners, edges and elsewhere: exact solutions."""
    shape = 83, 90
    observation = over_the_field(shape)
    system = sliding_camera(observation, diffracting(shape).types, (100.0,) * 3, 1 / P0)
    frames = SmallFrames(system, lambda _: 1 / P0, (1.0,) * 3, far=False)
    variance = (frames.relative(1.0) * frames.interior(1.0))[0]
    exact = FrameSystem(observation, np.full(observation.measurements, 100.0), 1 / P0)
    for place in ((0, 0), (41, 44), (41, 0), (82, 30), (20, 60), (60, 89), (5, 70), (70, 12)):
        unit = np.zeros(shape)
        unit[place] = 1.0
        solved = exact.solve(unit.ravel(), 1e-6).image.reshape(shape)
        assert variance[place] == pytest.approx(solved[place], rel=0.01), place


def test_a_map_without_variances_is_no_map() -> None:
    """A pixel whose variance is 0, infinite or NaN: random pixels may miss it, the verdict does not."""
    shape = 24, 21
    camera = diffracting(shape)
    system = FrameSystem(observed(camera), np.full(camera.measurements, 100.0), 1 / P0)
    frames = SmallFrames(
        sliding_camera(system.observation, camera.types, (100.0,) * 3, 1 / P0), lambda _: 1 / P0, (1.0,) * 3, far=False
    )
    variance = (frames.relative(1.0) * frames.interior(1.0))[0].ravel()
    exact = ExactVariances(system, None, 1e-4)
    assert check_map(variance, variance, shape, exact, local=True).worst < 0.01
    for wrong in (0.0, -np.inf, np.nan):
        changed = np.where(np.arange(variance.size) == 200, wrong, variance)
        assert check_map(changed, variance, shape, exact, local=True).worst >= 1.0
