"""Misalignments fitted to a stack: derivatives, errors against the truth, and the gain of the estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.reconstruct.misalignment.alignment import (
    Alignment,
    LikelihoodPoint,
    align,
    likelihood_at,
    misaligned_recording,
)
from ommatid.reconstruct.misalignment.robust_noise import misaligned_matrix, tolerances
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import misalignments

from ..examples import POSITION, TOLERANCES, as_table, drawn_from, familywise, misaligned_camera

NOISE = 1e-3
SIGNIFICANCE = 0.01
SIDE = 12


def true_table(camera: Camera) -> FloatArray:
    return as_table(misalignments(camera))


def recorded(camera: Camera, image: FloatArray, rng: np.random.Generator, table: FloatArray) -> FloatArray:
    light = misaligned_matrix(camera, table) @ image
    return light + NOISE**0.5 * rng.standard_normal(light.size)


def fitted(camera: Camera, values: FloatArray, prior: Prior) -> Alignment:
    return align(camera, values, np.full(values.size, NOISE), prior)


def chi_squared(fit: Alignment, table: FloatArray) -> float:
    """Sum of squared errors in units of their expected covariance, with a degree of freedom per parameter."""
    error = (as_table(fit.misalignments) - table)[tuple(fit.numbers.T)]
    return float(error @ np.linalg.solve(fit.covariance, error))


PRIORS = {
    "independent": independent(127.5, 5461.25, SIDE * SIDE),
    "exponential": exponential(127.5, 5461.25, (SIDE, SIDE), 8.0),
}


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("exponential", POSITION), *(pytest.param(name, TOLERANCES, marks=pytest.mark.slow) for name in PRIORS)],
)
def test_derivatives_agree_with_differences_of_the_value(name: str, tolerance: dict[str, Any]) -> None:
    camera, rng, prior = misaligned_camera(tolerance=tolerance), np.random.default_rng(1), PRIORS[name]
    values = recorded(camera, drawn_from(prior, rng), rng, true_table(camera))
    recording = misaligned_recording(camera, values, rng.uniform(0.5, 2.0, values.size), prior)
    point = likelihood_at(recording, rng.standard_normal(len(recording.free)))
    step, indices = 1e-4, rng.choice(len(recording.free), 3, replace=False)
    derivatives = point.derivatives(np.full(point.scores.size, step))
    curvature = derivatives.curvature()
    one_sub = np.equal.outer(recording.free[:, 0], recording.free[:, 0])
    for index in indices:
        unit = step * np.eye(point.scores.size)[index]
        above, below = (likelihood_at(recording, point.scores + sign * unit) for sign in (1, -1))
        assert (above.value - below.value) / (2 * step) == pytest.approx(
            derivatives.gradient[index], rel=1e-4, abs=1e-4
        )
        moved = (above.image - below.image) / (2 * step)
        np.testing.assert_allclose(derivatives.shifts[:, index], moved, rtol=1e-3, atol=1e-3 * np.abs(moved).max())
        # Between kinks H is linear in each offset, but second derivatives of H by two numbers of one lens are left out.
        gradients = [end.derivatives(np.full(point.scores.size, step)).gradient for end in (above, below)]
        differences, second = (gradients[0] - gradients[1]) / (2 * step), curvature[index]
        elsewhere = ~one_sub[index]
        scale = np.sqrt(np.diagonal(curvature) * curvature[index, index])
        np.testing.assert_allclose(
            second[elsewhere] / scale[elsewhere], differences[elsewhere] / scale[elsewhere], atol=2e-3
        )
        if tolerance is POSITION:
            assert second[index] == pytest.approx(differences[index], rel=2e-3)


def estimate_with(camera: Camera, values: FloatArray, prior: Prior, table: FloatArray) -> LikelihoodPoint:
    """The estimate of a camera with these misalignments."""
    matrix = misaligned_matrix(camera, table)
    recording = misaligned_recording(camera, values, np.full(values.size, NOISE), prior)
    return likelihood_at(replace(recording, matrix_of=lambda _: matrix), np.zeros(len(recording.free)))


@pytest.mark.slow
def test_errors_over_images_of_the_prior_are_as_large_as_expected() -> None:
    rng, prior = np.random.default_rng(2), PRIORS["exponential"]
    squares: list[float] = []
    excess: list[float] = []
    numbers: list[int] = []
    for seed in range(5):
        camera = misaligned_camera(seed=seed)
        image = drawn_from(prior, rng)
        values = recorded(camera, image, rng, true_table(camera))
        fit = fitted(camera, values, prior)
        point = estimate_with(camera, values, prior, as_table(fit.misalignments))
        squares.append(chi_squared(fit, true_table(camera)))
        numbers.append(len(fit.numbers))
        excess.append(float(np.mean((point.image - image) ** 2 - np.diagonal(point.covariance) - fit.variance)))
    # Parameters on a kink are not Gaussian, and one fit of ten ends on its wrong side: medians are like chi-squared.
    degrees = float(np.median(numbers))
    low, high = stats.chi2.ppf(SIGNIFICANCE / 2, degrees), stats.chi2.isf(SIGNIFICANCE / 2, degrees)
    assert low < np.median(squares) < 1.2 * high
    t = np.mean(excess) / (np.std(excess, ddof=1) / len(excess) ** 0.5)
    assert abs(t) < stats.t.isf(SIGNIFICANCE / 2, len(excess) - 1)


def test_an_aligned_camera_is_fitted_as_aligned() -> None:
    camera, rng, prior = misaligned_camera(), np.random.default_rng(4), PRIORS["exponential"]
    fit = fitted(camera, recorded(camera, drawn_from(prior, rng), rng, 0 * true_table(camera)), prior)
    z = as_table(fit.misalignments)[tuple(fit.numbers.T)] / as_table(fit.deviations)[tuple(fit.numbers.T)]
    assert np.abs(z).max() < stats.norm.isf(familywise(z.size) / 2)
    assert (as_table(fit.deviations) < tolerances(camera) + 1e-12).all(), "a stack adds information to the tolerance"


def test_without_information_the_tolerance_remains() -> None:
    camera, rng, prior = misaligned_camera(), np.random.default_rng(5), PRIORS["exponential"]
    values = recorded(camera, drawn_from(prior, rng), rng, true_table(camera))
    fit = align(camera, values, np.full(values.size, 1e8), prior)
    np.testing.assert_allclose(as_table(fit.deviations), tolerances(camera), rtol=1e-3)
    assert np.abs(as_table(fit.misalignments)).max() < 0.01 * tolerances(camera).max()


@pytest.mark.slow
def test_pixels_left_out_act_as_pixels_of_infinite_noise() -> None:
    camera, rng, prior = misaligned_camera(), np.random.default_rng(6), PRIORS["exponential"]
    values = recorded(camera, drawn_from(prior, rng), rng, true_table(camera))
    used = rng.random(values.size) < 0.9
    noise = np.where(used, NOISE, 1e12)
    masked, drowned = align(camera, values[used], noise[used], prior, used), align(camera, values, noise, prior)
    assert np.abs(as_table(masked.misalignments) - as_table(drowned.misalignments)).max() < 0.1 * 40e-6
    assert masked.matrix.shape == drowned.matrix.shape


def test_variance_of_a_sum_of_one_pixel_is_that_of_the_pixel() -> None:
    camera, rng, prior = misaligned_camera(), np.random.default_rng(7), PRIORS["exponential"]
    fit = fitted(camera, recorded(camera, drawn_from(prior, rng), rng, true_table(camera)), prior)
    assert fit.variance_of_sum(np.eye(prior.mean.size)[5]) == pytest.approx(fit.variance[5])


def test_cameras_that_cannot_be_aligned_are_refused() -> None:
    camera, prior = misaligned_camera(), PRIORS["independent"]
    values = np.zeros(camera.measurements)
    with pytest.raises(InputError, match=r"add a \[camera\.tolerance\]"):
        align(replace(camera, tolerance=None), values, values + 1, prior)
    with pytest.raises(InputError, match="needs noise in every measurement"):
        align(camera, values, values, prior)
    with pytest.raises(InputError, match="up to 4000 pixels of f, got 100 x 100; take 'robust'"):
        align(misaligned_camera(100), values, values + 1, prior)
