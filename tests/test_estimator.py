"""Eq. 4 and Eq. 5 against other methods: limits, laws, a Bayesian by brute force, and images drawn from the prior."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse, stats

from reconstruct.estimator import estimate, expected_error, factorise, noise_covariance
from scenes.errors import InputError
from simulate.ideal import ideal_matrix

from .examples import THREE, camera

Vector = NDArray[np.float64]
Form = Literal["measurement", "information"]
FORMS: list[Form] = ["measurement", "information"]


def problem(seed: int = 0, m: int = 7, n: int = 5) -> tuple[sparse.csr_array, Vector, Vector]:
    rng = np.random.default_rng(seed)
    return sparse.csr_array(rng.normal(size=(m, n))), rng.uniform(1, 50, n), rng.uniform(0.1, 2, m)


@pytest.mark.parametrize("form", FORMS)
def test_against_conditioning_a_joint_gaussian_one_measurement_at_a_time(
    form: Literal["measurement", "information"],
) -> None:
    """Sequential scalar updates (a Kalman filter without dynamics) share no formula with either form."""
    matrix, prior, noise = problem()
    rng = np.random.default_rng(1)
    mean, g = rng.normal(size=5), rng.normal(size=7)
    image, covariance = mean.copy(), np.diag(prior)
    for row, reading, variance in zip(matrix.toarray(), g, noise, strict=True):
        direction = covariance @ row
        innovation = row @ direction + variance
        image = image + direction * (reading - row @ image) / innovation
        covariance = covariance - np.outer(direction, direction) / innovation
    gain = factorise(matrix, prior, noise, form)
    np.testing.assert_allclose(estimate(gain, g, mean), image, rtol=1e-10)
    expected = expected_error(gain, prior, {"noise": noise})
    np.testing.assert_allclose(expected.variance, np.diag(covariance), rtol=1e-10)


@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 9))
@settings(max_examples=60, deadline=None)
def test_both_forms_agree(seed: int, m: int, n: int) -> None:
    matrix, prior, noise = problem(seed, m, n)
    g, mean = np.random.default_rng(seed + 1).normal(size=m), np.zeros(n)
    actual = np.random.default_rng(seed + 2).uniform(0, 3, m)
    results = [factorise(matrix, prior, noise, form) for form in FORMS]
    np.testing.assert_allclose(*(estimate(gain, g, mean) for gain in results), rtol=1e-7, atol=1e-9)
    errors = [expected_error(gain, 2 * prior, {"noise": actual}) for gain in results]
    np.testing.assert_allclose(errors[0].variance, errors[1].variance, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(*(noise_covariance(gain, actual) for gain in results), rtol=1e-6, atol=1e-9)


@given(st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_more_measurements_never_raise_the_expected_error(seed: int) -> None:
    matrix, prior, noise = problem(seed, 8, 6)
    fewer = expected_error(factorise(matrix[:5], prior, noise[:5]), prior, {"noise": noise[:5]})
    more = expected_error(factorise(matrix, prior, noise), prior, {"noise": noise})
    assert (more.variance <= fewer.variance * (1 + 1e-9)).all()


@given(st.integers(0, 10**6), st.floats(0.1, 10))
@settings(max_examples=40, deadline=None)
def test_a_wrong_expectation_never_lowers_the_error(seed: int, factor: float) -> None:
    """The estimate that expects the real noise has the least error of all linear ones."""
    matrix, prior, noise = problem(seed, 8, 6)
    right = expected_error(factorise(matrix, prior, noise), prior, {"noise": noise})
    wrong = expected_error(factorise(matrix, prior, noise * factor), prior, {"noise": noise})
    assert (wrong.variance >= right.variance * (1 - 1e-9)).all()


def test_limits() -> None:
    """Much noise: the prior. Little noise: the image, where H sees it. The identity: one weight a pixel."""
    matrix, prior, noise = problem(3, 9, 5)
    image = np.random.default_rng(4).normal(size=5)
    blind = factorise(matrix, prior, noise * 1e12)
    assert expected_error(blind, prior, {"noise": noise * 1e12}).variance == pytest.approx(prior, rel=1e-6)
    sharp = factorise(matrix, prior, noise * 1e-8)
    assert estimate(sharp, matrix @ image, np.zeros(5)) == pytest.approx(image, rel=1e-6)
    identity = factorise(sparse.csr_array(np.eye(4)), np.full(4, 3.0), np.full(4, 1.0))
    assert estimate(identity, np.full(4, 8.0), np.full(4, 4.0)) == pytest.approx(np.full(4, 4 + 4 * 3 / 4))
    assert expected_error(identity, np.full(4, 3.0), {"noise": np.ones(4)}).variance == pytest.approx(np.full(4, 3 / 4))


def test_parts_add_up() -> None:
    matrix, prior, noise = problem(5, 9, 6)
    parts = {"noise": 0.3 * noise, "rendering": 0.7 * noise}
    expected = expected_error(factorise(matrix, prior, noise), prior, parts)
    assert expected.missing + sum(expected.parts.values()) == pytest.approx(expected.mse)
    assert expected.parts["rendering"] == pytest.approx(expected.parts["noise"] * 7 / 3)


@pytest.mark.parametrize("lenses", [THREE, THREE[:2], THREE[:1]])
def test_eq_5_holds_over_images_drawn_from_the_prior(lenses: tuple[tuple[str, list[int], list[int]], ...]) -> None:
    """The squared error of many images and noises drawn as the scene says, pixel by pixel, against its variance."""
    one = camera(lenses=lenses)
    matrix = ideal_matrix(one)
    rng = np.random.default_rng(7)
    draws, variance, noise = 400, 5461.25, 0.5
    gain = factorise(matrix, np.full(361, variance), np.full(one.measurements, noise))
    expected = expected_error(gain, np.full(361, variance), {"noise": np.full(one.measurements, noise)})
    images = rng.normal(127.5, variance**0.5, (361, draws))
    recorded = matrix @ images + rng.normal(0, noise**0.5, (one.measurements, draws))
    mean = np.full((361, 1), 127.5)
    error = mean + gain.apply(recorded - matrix @ mean) - images
    score = np.sum(error**2, axis=1) / expected.variance
    limit = stats.chi2.ppf([0.005 / 361, 1 - 0.005 / 361], draws)
    assert limit[0] < score.min()
    assert score.max() < limit[1]


def test_a_mismatched_expectation_is_predicted_too() -> None:
    """Eq. 5 with other actual than expected noise, against the errors themselves."""
    one = camera()
    matrix = ideal_matrix(one)
    rng = np.random.default_rng(8)
    draws = 300
    gain = factorise(matrix, np.full(361, 5461.25), np.full(706, 1.0))
    expected = expected_error(gain, np.full(361, 1000.0), {"noise": np.full(706, 4.0)})
    images = rng.normal(0, 1000**0.5, (361, draws))
    error = gain.apply(matrix @ images + rng.normal(0, 2.0, (706, draws))) - images
    assert np.mean(error**2) == pytest.approx(expected.mse, rel=0.05)


@pytest.mark.parametrize("form", FORMS)
def test_what_float64_cannot_do_is_refused(form: Form) -> None:
    matrix = sparse.csr_array(np.ones((3, 2)))
    with pytest.raises(InputError, match="above 0"):
        factorise(matrix, np.ones(2), np.zeros(3), form)
    with pytest.raises(InputError, match="positive definite"):
        factorise(matrix, np.full(2, 1e30), np.full(3, 1e-30), form)


def test_too_large_a_problem_is_refused_before_memory_is_asked_for() -> None:
    matrix = sparse.csr_array((10**6, 10**6))
    with pytest.raises(InputError, match="GB"):
        factorise(matrix, np.ones(10**6), np.ones(10**6))
