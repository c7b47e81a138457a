"""Misaligned cameras: moments of H and the cost of a tolerance against random cameras; fitted misalignments."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.misalignment.alignment import Alignment, align
from ommatid.reconstruct.misalignment.moments import (
    as_misalignments,
    misaligned_matrix,
    misaligned_moments,
    mismatch_variance,
    points_of,
    tolerances,
)
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensOptics
from ommatid.scenes.pose import misalignments
from ommatid.scenes.tables.camera import Surface
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import GALLERY, POSITION, TOLERANCES, as_table, drawn_from, familywise, form_of, misaligned_camera, slow
from ..runs import document

SIGNIFICANCE = 0.01
SIDE = 12


def priors(side: int = SIDE) -> dict[str, Prior]:
    return {
        "independent": independent(127.5, 5461.25, side * side),
        "exponential": exponential(127.5, 5461.25, (side, side), 20.0),
    }


def drawn_matrix(camera: Camera, rng: np.random.Generator) -> Any:
    spread = tolerances(camera)
    return misaligned_matrix(camera, spread * rng.standard_normal(spread.shape))


def test_points_have_the_moments_of_independent_normal_parameters() -> None:
    weights, points = points_of(np.ones(6, dtype=np.bool_))
    assert weights.sum() == pytest.approx(1, rel=1e-14)
    assert weights @ points == pytest.approx(np.zeros(6), abs=1e-14)
    assert points.T @ (weights[:, None] * points) == pytest.approx(np.eye(6), abs=1e-13)
    assert weights @ np.abs(points) ** 3 == pytest.approx(np.full(6, stats.halfnorm.moment(3)), rel=1e-13)
    absolute = np.full((6, 6), stats.halfnorm.mean() ** 2)
    np.fill_diagonal(absolute, 1)
    assert np.abs(points).T @ (weights[:, None] * np.abs(points)) == pytest.approx(absolute, rel=1e-13)


def test_a_parameter_has_the_same_distribution_whatever_others_there_are() -> None:
    """So that vanishing tolerances beside others change nothing."""
    weights, points = points_of(np.ones(6, dtype=np.bool_))
    for free in (np.arange(6) == 4, np.arange(6) < 2):
        fewer, of_fewer = points_of(free)
        assert len(fewer) <= 36, "equal points are joined"
        assert not of_fewer[:, ~free].any()
        for weight, point in zip(fewer, of_fewer, strict=True):
            assert weights[(points[:, free] == point[free]).all(axis=1)].sum() == pytest.approx(weight, rel=1e-14)


def test_tables_hold_the_drawn_misalignments() -> None:
    scores: list[FloatArray] = []
    for seed in range(20):
        camera = misaligned_camera(tolerance=TOLERANCES | {"seed": seed})
        drawn = misalignments(camera)
        assert as_misalignments(as_table(drawn)) == drawn
        scores.append(as_table(drawn) / tolerances(camera))
    assert stats.kstest(np.ravel(scores), "norm").pvalue > SIGNIFICANCE


@pytest.mark.parametrize(
    ("name", "tolerance", "draws"),
    [
        pytest.param("independent", POSITION, 50, id="0.03 pixels, few"),
        slow("independent", POSITION, 300, id="0.03 pixels"),
        slow("exponential", {"position": "600 nm"}, 300, id="0.4 pixels"),
        slow("exponential", TOLERANCES, 300, id="all"),
    ],
)
def test_moments_agree_with_random_cameras_and_images(name: str, tolerance: dict[str, Any], draws: int) -> None:
    camera, rng, prior = misaligned_camera(tolerance=tolerance), np.random.default_rng(1), priors()[name]
    misaligned = misaligned_moments(camera, prior)
    residuals = np.empty((draws, camera.measurements))
    for draw in range(draws):
        residuals[draw] = (drawn_matrix(camera, rng) - misaligned.matrix) @ drawn_from(prior, rng)
    for rows, covariance in zip(camera.slices(), misaligned.covariances, strict=True):
        of_sub = residuals[:, rows]
        # Along the eigenvectors, so that independent numbers of expected square 1 are compared.
        values, vectors = np.linalg.eigh(covariance)
        strong = values > 1e-3 * values[-1]
        squares = np.square(of_sub @ vectors[:, strong]) / values[strong]
        assert abs(squares.mean() - 1) < 5 * squares.mean(axis=1).std() / draws**0.5 + 0.05
    z = residuals.mean(axis=0) / (residuals.std(axis=0) / draws**0.5)
    assert np.abs(z).max() < 5


def test_without_tolerance_nothing_is_added() -> None:
    camera = replace(misaligned_camera(), tolerance=None)
    misaligned = misaligned_moments(camera, priors()["independent"])
    assert not any(block.any() for block in misaligned.covariances)


def test_blurred_lenses_are_refused() -> None:
    camera = misaligned_camera()
    real = Surface.model_validate({"radius": "1 mm", "semi_diameter": "0.1 mm"})
    for optics in (LensOptics(surfaces=(real,)), LensOptics(aperture=0.1, focus=500.0)):
        lens_type = replace(camera.types[0], optics=optics)
        with pytest.raises(InputError, match=r"camera\.lens\.A: .* take estimator\.misalignment = 'trust'"):
            tolerances(replace(camera, types=(lens_type, *camera.types[1:])))


# --- the predicted cost of a tolerance


def cost_of(camera: Camera, variance: float = 1e-2) -> float:
    prior, used = independent(127.5, 5461.25, camera.unknowns), np.ones(camera.measurements, dtype=np.bool_)
    form = form_of(Problem(ideal_matrix(camera), prior, np.full(camera.measurements, variance)))
    moments = misaligned_moments(camera, prior)
    return float(mismatch_variance(form, used, moments, camera.slices(), prior).mean())


def mean_over(camera: Camera, tables: FloatArray, variance: float = 1e-2) -> tuple[float, float]:
    """Mean over misalignments of what each adds to the expected squared error, and its standard error over groups.

    tables : (groups, cameras, sub-imagers, 6);  with H' a camera's matrix, of P0 the share (I - A H') remains, and
    the prior's mean is off by A (H - H') f0
    """
    prior, designed = independent(127.5, 5461.25, camera.unknowns), ideal_matrix(camera).toarray()
    noise = variance * np.eye(camera.measurements)
    gain = 5461.25 * designed.T @ np.linalg.inv(5461.25 * designed @ designed.T + noise)
    expected = 5461.25 * np.square(np.eye(camera.unknowns) - gain @ designed).sum()
    costs: list[float] = []
    for table in tables.reshape(-1, *tables.shape[2:]):
        seen = gain @ misaligned_matrix(camera, table).toarray()
        off = gain @ (designed @ prior.mean) - seen @ prior.mean
        error = 5461.25 * np.square(np.eye(camera.unknowns) - seen).sum() + np.square(off).sum()
        costs.append(float(error - expected) / camera.unknowns)
    means = np.mean(np.reshape(costs, tables.shape[:2]), axis=1)
    return float(means.mean()), float(means.std(ddof=1)) / means.size**0.5


def random_misalignments(camera: Camera, groups: int, cameras: int) -> FloatArray:
    """Normal misalignments, in every group one of each sub-imager's in each of equally likely intervals."""
    spread, rng = tolerances(camera), np.random.default_rng(3)
    order = rng.permuted(np.broadcast_to(np.arange(cameras)[:, None, None], (groups, cameras, *spread.shape)), axis=1)
    return spread * stats.norm.ppf((order + rng.random(order.shape)) / cameras)


@pytest.mark.parametrize(
    "tolerance",
    [{"position": "20 nm"}, slow({"rotation": "0.1 deg"}), slow({"focal_length": 1e-3})],
    ids=lambda each: next(iter(each)),
)
def test_the_cost_of_one_tolerance_is_that_of_random_cameras(tolerance: dict[str, float | str]) -> None:
    """Points whose second moments are a quarter too large fail."""
    camera = misaligned_camera(tolerance=tolerance)
    mean, error = mean_over(camera, random_misalignments(camera, 10, 12))
    assert cost_of(camera) == pytest.approx(mean, abs=3 * error)
    assert error < 0.03 * mean, "too few cameras to tell"


@pytest.mark.slow
def test_predict_includes_the_cost(ommatid: Command) -> None:
    tile = (GALLERY / "tile19.toml", "--no-rays", "--set", "noise.variance=1e-2")
    (strict,) = document(ommatid("predict", *tile, "--json"))
    (loose,) = document(ommatid("predict", *tile, "--set", 'camera.tolerance.position="10 nm"', "--json"))
    assert "misalignment" not in strict
    assert loose["mse"] == pytest.approx(strict["mse"] + loose["misalignment"], rel=1e-6)
    assert loose["misalignment"] > 1
    assert "from misalignment" in ommatid("predict", *tile, "--set", 'camera.tolerance.position="10 nm"').out
    tolerant = ("--set", 'camera.tolerance.position="41 nm"')
    (designed,) = document(ommatid("predict", *tile, *tolerant, "--json"))
    (fitted,) = document(ommatid("predict", *tile, *tolerant, "--set", "estimator.misalignment=fit", "--json"))
    assert fitted["budget"]["misalignment"] < 0.1 * designed["budget"]["misalignment"], "H is fitted to the readings"


@pytest.mark.slow
def test_predict_with_saturated_pixels_and_with_blurred_lenses(ommatid: Command) -> None:
    """Saturated pixels are left out of both; a cost without closed form is reported as missing."""
    loose = ("--set", 'camera.tolerance.position="10 nm"')
    aperture = ["--set", "camera.lens.*.aperture=0.4 mm", "--set", "camera.wavelength=none"]
    sensor = ("--set", "noise=", "--set", 'sensor.illuminance="500 lux"', "--set", 'sensor.exposure="10 ms"')
    (bright,) = document(ommatid("predict", "--no-rays", GALLERY / "tile19.toml", *aperture, *sensor, *loose, "--json"))
    assert bright["measurements"] < 706
    assert bright["misalignment"] > 0
    known = ("--set", "prior.kind=independent")  # a fitted prior takes a stack
    lens = ommatid("predict", "--no-rays", GALLERY / "doublet.toml", *loose, *known)
    assert lens.code == 0
    assert "not included" in lens.out
    assert "not included" not in ommatid("predict", "--no-rays", GALLERY / "tile19.toml", *loose).out


# --- misalignments fitted to a stack


NOISE = 1e-3


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


@pytest.mark.parametrize("name", [slow("independent"), "exponential"])
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
