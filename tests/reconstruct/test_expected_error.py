"""Eq. 5 against the errors of images drawn from the prior, by every form; and the diagnostics beside it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from ommatid.reconstruct.estimator.estimate import FORMS
from ommatid.reconstruct.expected_error import expected_error, expected_given
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.simulate.ideal import ideal_matrix

from ..examples import camera, form_of, posterior_covariance, tile_problem


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
