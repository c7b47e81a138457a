"""Misalignments fitted to a stack: errors against the truth, and the gain of the estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.misalignment.alignment import Alignment, align
from ommatid.reconstruct.misalignment.moments import misaligned_matrix, tolerances
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import misalignments

from ..examples import TOLERANCES, as_table, drawn_from, familywise, misaligned_camera

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


@pytest.mark.parametrize("name", [pytest.param("independent", marks=pytest.mark.slow), "exponential"])
def test_all_parameters_are_fitted_better_than_the_tolerance_knows_them(name: str) -> None:
    """Fitted numbers and the estimate with them are nearer to the truth than the design is, though H has kinks."""
    camera, rng, prior = misaligned_camera(tolerance=TOLERANCES), np.random.default_rng(0), PRIORS[name]
    image, true = drawn_from(prior, rng), true_table(camera)
    values = recorded(camera, image, rng, true)
    fit = fitted(camera, values, prior)
    scale = tolerances(camera)
    assert np.square((as_table(fit.misalignments) - true) / scale).sum() < np.square(true / scale).sum()
    by_fit, by_design = (
        estimate(Problem(matrix, prior, np.full(values.size, NOISE)), values).image
        for matrix in (fit.matrix, misaligned_matrix(camera, 0 * true))
    )
    assert np.mean((by_fit - image) ** 2) < np.mean((by_design - image) ** 2)


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
        solved = estimate(Problem(fit.matrix, prior, np.full(values.size, NOISE)), values)
        squares.append(chi_squared(fit, true_table(camera)))
        numbers.append(len(fit.numbers))
        excess.append(float(np.mean((solved.image - image) ** 2 - solved.form.variance() - fit.variance)))
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
