"""Eq. 5 against the errors of images drawn from the prior, by every form; and the diagnostics beside it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse, stats

from ommatid.reconstruct.estimator.estimate import FORMS
from ommatid.reconstruct.expected_error import expected_error, expected_given, variance_of_sum
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.simulate.ideal import ideal_matrix

from ..examples import camera, form_of, posterior_covariance, random_problem, tile_problem


@given(st.integers(0, 10**6), st.floats(0.1, 10))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_expecting_another_noise_never_lowers_the_error(seed: int, factor: float) -> None:
    """The estimator that expects the actual noise has the least error of all linear ones."""
    known = random_problem(seed, 8, 6)
    noise = {"noise": known.noise_variance}
    right = expected_error(form_of(known), noise)
    mismatched = Problem(known.matrix, known.prior, factor * known.noise_variance)
    assert (expected_error(form_of(mismatched), noise).variance >= right.variance * (1 - 1e-9)).all()


@pytest.mark.parametrize("lenses", [3, 2, 1])
def test_eq_5_is_the_covariance_of_the_error_by_every_form(lenses: int) -> None:
    """(I - A H) P0 (I - A H)^T + A Rvm A^T of the form's own A, with the expected noise and with four times that."""
    small = camera((12, 12), (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"), ("1/4", [3, 4], "fit"))[:lenses])
    matrix, noise = ideal_matrix(small), np.random.default_rng(7).uniform(0.3, 0.7, small.measurements)
    known = Problem(matrix, independent(127.5, 5461.25, 144), noise)
    for form in FORMS:
        factorised = FORMS[form](known)
        gain = factorised.gain(np.eye(small.measurements))
        hidden = np.eye(144) - gain @ matrix.toarray()
        missing = 5461.25 * hidden @ hidden.T
        for ratio in (1.0, 4.0):
            expected = expected_error(factorised, {"noise": ratio * noise})
            covariance = missing + gain @ (ratio * noise[:, None] * gain.T)
            np.testing.assert_allclose(expected.variance, np.diagonal(covariance), rtol=1e-6)
            assert expected.missing == pytest.approx(np.trace(missing) / 144, rel=1e-6)
        np.testing.assert_allclose(
            posterior_covariance(factorised), missing + gain @ (noise[:, None] * gain.T), atol=1e-5
        )


@pytest.mark.slow
@pytest.mark.parametrize("lenses", [3, 1])
def test_eq_5_holds_over_a_thousand_images_drawn_from_the_prior(lenses: int) -> None:
    """The whitened error is chi-squared, with every pixel and with all of them together.

    One type leaves a null space, three leave none: both the prior's part and the noise's are tested.
    """
    known = tile_problem(lenses, 0.5)
    draws, unknowns = 1000, known.unknowns
    factorised = form_of(known)
    covariance = posterior_covariance(factorised)
    rng = np.random.default_rng(7)
    images = rng.normal(127.5, known.prior.root[:, None], (unknowns, draws))
    recorded = known.matrix @ images + rng.normal(0, 0.5**0.5, (known.measurements, draws))
    mean = np.full((unknowns, 1), 127.5)
    error = mean + factorised.gain(recorded - known.matrix @ mean) - images
    score = np.sum(error**2, axis=1) / factorised.variance()
    limit = stats.chi2.ppf([0.0005 / unknowns, 1 - 0.0005 / unknowns], draws)  # all pixels 999 times in 1000
    assert limit[0] < score.min()
    assert score.max() < limit[1]
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), error)
    together = float(np.sum(whitened**2))
    assert 0.0005 < float(stats.chi2.cdf(together, draws * unknowns)) < 0.9995


def test_the_error_under_another_prior_than_expected_is_predicted() -> None:
    """Eq. 5 with a correlated prior and four times the noise: the mean over images of the error given the image.

    Against trace((I - A H) P (I - A H)^T + A Rv A^T) / N in dense matrices, column by column of the root of P.
    """
    known, actual = tile_problem(3, 1.0), exponential(127.5, 1000.0, (19, 19), 4.0)
    noise, unknowns = np.full(known.measurements, 4.0), known.unknowns
    form = form_of(known)
    gain, root = form.gain(np.eye(known.measurements)), actual.apply_root(np.eye(actual.dimension))
    bias = root - gain @ (known.matrix @ root)
    without_image = expected_given(form, actual.mean, noise).mse
    directions = [0, 150, 360]
    given = [expected_given(form, actual.mean + root[:, column], noise).mse for column in directions]
    excess = (np.array(given) - without_image) * unknowns
    assert excess == pytest.approx(np.sum(bias[:, directions] ** 2, axis=0), rel=1e-6)
    assert without_image == pytest.approx(4.0 * np.sum(gain**2) / unknowns, rel=1e-9)


@pytest.mark.parametrize("wide", [False, True])
def test_the_interval_holds_99_of_100_errors(wide: bool) -> None:
    """For one image and many draws of the noise, with an estimator that expects another noise."""
    rng = np.random.default_rng(2)
    matrix = sparse.csr_array(rng.normal(size=(60, 30)) / np.geomspace(1, 300 if wide else 2, 30))
    noise = rng.uniform(0.2, 2, 60)
    truth = rng.normal(0, 2, 30)
    form = form_of(Problem(matrix, Prior(np.zeros(30), np.full(30, 3.0)), 2 * noise))
    interval = expected_given(form, truth, noise)
    draws = 20_000
    recorded = (matrix @ truth)[:, None] + rng.normal(size=(60, draws)) * np.sqrt(noise)[:, None]
    errors = np.mean((form.gain(recorded) - truth[:, None]) ** 2, axis=0)
    assert abs(errors.mean() - interval.mse) < 4 * errors.std(ddof=1) / draws**0.5
    outside = np.mean((errors < interval.low) | (errors > interval.high))
    assert 0.005 < outside < 0.02, "1 %, within a factor of two: a gamma variate is an approximation"


def test_the_error_of_a_regions_mean() -> None:
    """By the covariance of the errors, in which those of neighbours cancel."""
    known = tile_problem(2, 1.0)
    form = form_of(known)
    weights = np.zeros((19, 19))
    weights[5:11, 6:12] = 1 / 36
    flat = weights.ravel()
    variance = variance_of_sum(form, flat, known.noise_variance)
    assert variance == pytest.approx(flat @ posterior_covariance(form) @ flat, rel=1e-9)
    assert variance < 0.5 * float(flat**2 @ form.variance()), "neighbours' errors cancel"


def test_degrees_of_freedom_and_resolution() -> None:
    """Without noise the degrees of freedom are the rank of H; a pixel seen alone at P0 / Rv = 3 has 3/4 of one."""
    assert expected_error(form_of(tile_problem(3, 1e-9)), {}).degrees_of_freedom == pytest.approx(361, abs=1e-6)
    assert expected_error(form_of(tile_problem(2, 1e-9)), {}).degrees_of_freedom == pytest.approx(329, abs=1e-6)
    matrix = sparse.csr_array(np.diag([1.0, 1.0, 0.0]))
    known = Problem(matrix, Prior(np.zeros(3), np.full(3, 3.0**0.5)), np.array([1.0, 1e-12, 1.0]))
    expected = expected_error(form_of(known), {"noise": known.noise_variance})
    assert expected.resolved == pytest.approx([0.75, 1, 0])
    assert expected.resolution == pytest.approx([(4 / 3) ** 0.5, 1, np.inf])


def test_resolution_of_a_blur_is_its_width() -> None:
    """Sensor pixels that each average m x m target pixels, side by side: m pixels share one degree of freedom."""
    side_by_side = camera((12, 12), (("1/3", [1, 1], [4, 4]),))
    prior = Prior(np.zeros(144), np.full(144, 50.0))
    form = form_of(Problem(ideal_matrix(side_by_side), prior, np.full(16, 1e-9)))
    assert expected_error(form, {}).resolution == pytest.approx(np.full(144, 3.0))
