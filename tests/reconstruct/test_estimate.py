"""Eq. 4 against other methods, limits and laws; the choice of the form and its certificate.

Tolerances between methods follow from the condition of the random problems, at most some 1e4 for these seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from ommatid.reconstruct.estimator.certificate import variance_error
from ommatid.reconstruct.estimator.estimate import FORMS, TOLERANCE, estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.reconstruct.forms.cholesky import information
from ommatid.reconstruct.forms.square_root import square_root
from ommatid.reconstruct.prior import Prior, independent
from ommatid.reconstruct.problem import NotSolvableError, Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..examples import covariance_of, form_of, not_none, posterior_covariance, random_problem, tile_problem


def sequential_update(problem: Problem, g: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sequential scalar updates, a Kalman filter without dynamics: shares no formula with the solver."""
    image = problem.prior.mean.copy()
    covariance = covariance_of(problem.prior)
    for row, reading, variance in zip(problem.matrix.toarray(), g, problem.noise_variance, strict=True):
        direction = covariance @ row
        innovation = row @ direction + variance
        image = image + direction * (reading - row @ image) / innovation
        covariance = covariance - np.outer(direction, direction) / innovation
    return image, covariance


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [(7, 5), (4, 6), (1, 1)])
def test_sequential_updates_give_the_same_estimate(form: str, shape: tuple[int, int]) -> None:
    problem = random_problem(3, *shape, correlated=shape[0] > 4)
    g = np.random.default_rng(1).normal(size=shape[0])
    image, covariance = sequential_update(problem, g)
    factorised, prior = FORMS[form](problem), problem.prior
    residual = (g - problem.matrix @ prior.mean)[:, None]
    u, multipliers = factorised.solve(np.zeros((prior.dimension, 1)), residual)
    np.testing.assert_allclose(prior.mean + prior.apply_root(u[:, 0]), image, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(factorised.variance(), np.diag(covariance), rtol=1e-8)
    np.testing.assert_allclose(posterior_covariance(factorised), covariance, rtol=1e-8, atol=1e-9)
    expected = (g - problem.matrix @ image) / problem.noise_variance
    np.testing.assert_allclose(multipliers[:, 0], expected, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(estimate(problem, g).image, image, rtol=1e-9, atol=1e-10)


@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 9), st.booleans())
@settings(max_examples=25, deadline=None, derandomize=True)
def test_estimate_and_variances_of_any_problem(seed: int, m: int, n: int, correlated: bool) -> None:
    problem = random_problem(seed, m, n, correlated=correlated)
    g = np.random.default_rng(seed + 1).normal(size=m)
    solution, (image, covariance) = estimate(problem, g), sequential_update(problem, g)
    np.testing.assert_allclose(solution.image, image, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(solution.form.variance(), np.diag(covariance), rtol=1e-6)


def test_limits() -> None:
    """Much noise: the prior. Little noise: the image, if H has full rank. The identity: one weight per pixel."""
    problem = random_problem(3, 9, 5)
    image = np.random.default_rng(4).normal(size=5)
    noisy = Problem(problem.matrix, problem.prior, problem.noise_variance * 1e12)
    assert form_of(noisy).variance() == pytest.approx(problem.prior.variance, rel=1e-6)
    for factor in (1e-8, 0.0):
        sharp = Problem(problem.matrix, problem.prior, problem.noise_variance * factor)
        assert estimate(sharp, problem.matrix @ image).image == pytest.approx(image, rel=1e-6)
    identity = Problem(sparse.csr_array(np.eye(4)), independent(4.0, 3.0, 4), np.full(4, 1.0))
    solution = estimate(identity, np.full(4, 8.0))
    assert solution.image == pytest.approx(np.full(4, 4 + 4 * 3 / 4))
    assert solution.form.variance() == pytest.approx(np.full(4, 3 / 4))


@pytest.mark.parametrize(
    ("lens_types", "noise", "method", "failed"),
    [
        (3, 1e-2, "information", []),
        (2, 1e-2, "information", []),
        (2, 1e-6, "covariance", ["information"]),
        (2, 1e-12, "square-root", ["information", "covariance"]),
        (1, 1e-2, "covariance", []),
    ],
)
def test_a_more_robust_form_runs_if_the_bound_is_large(
    lens_types: int, noise: float, method: str, failed: list[str]
) -> None:
    """The shape decides on the first form, the certificate on the last; every rejected form has a reason."""
    problem = tile_problem(lens_types, noise)
    rng = np.random.default_rng(0)
    g = problem.matrix @ rng.uniform(0, 255, 361) + rng.normal(0, noise**0.5, problem.measurements)
    solver = estimate(problem, g).solver
    assert solver.method == method
    assert [form.method for form in solver.tried] == failed
    assert all(form.why_not for form in solver.tried)
    assert not_none(solver.bound) <= TOLERANCE
    assert solver.variance_bound <= TOLERANCE
    assert solver.digits >= 8


def test_noise_that_differs_widely_between_measurements() -> None:
    """Updates from the least to the most noise are accurate to the rounding of 1e-6."""
    problem = random_problem(5, 9, 6)
    noise = np.geomspace(1e-12, 1e6, 9)
    solution = estimate(Problem(problem.matrix, problem.prior, noise), np.arange(9.0))
    descending = Problem(problem.matrix[::-1], problem.prior, noise[::-1])
    image, _ = sequential_update(descending, np.arange(9.0)[::-1])
    assert solution.image == pytest.approx(image, rel=1e-6)


def test_the_certificate_detects_a_wrong_factorisation() -> None:
    """A factorisation for a prior standard deviation 5 % larger: variances are wrong by more than 5 %."""
    problem = tile_problem(3, 1e-4)
    right = square_root(problem)
    wider = Problem(problem.matrix, Prior(problem.prior.mean, problem.prior.root * 1.05), problem.noise_variance)
    wrong = square_root(wider)
    mixed = type(right)(problem, wrong.condition, wrong.normal)
    assert variance_error(right, ExactResiduals(problem)) < 1e-12
    assert variance_error(mixed, ExactResiduals(problem)) > 0.05
    weak = information(tile_problem(2, 1e-6))
    assert variance_error(weak, ExactResiduals(weak.problem)) > 1e-9


LARGE = 10**6
REPEATED = Problem(sparse.csr_array(np.ones((3, 2))), independent(0.0, 1.0, 2), np.zeros(3))


def test_repeated_measurements_without_noise_are_solved_where_they_agree() -> None:
    assert estimate(REPEATED, np.ones(3)).image == pytest.approx([0.5, 0.5])
    for form in ("information", "square-root"):
        with pytest.raises(NotSolvableError, match="noise in every measurement"):
            FORMS[form](REPEATED)


def other(**fields: Any) -> Problem:
    return replace(REPEATED, **fields)


@pytest.mark.parametrize(
    ("refused", "words"),
    [
        (lambda: estimate(REPEATED, np.array([1.0, 2.0, 3.0])), "contradict one another"),
        (lambda: estimate(REPEATED, np.array([1.0, np.nan, 3.0])), "dead pixels"),
        (lambda: other(noise_variance=np.array([1.0, np.nan, 1.0])), "noise variances"),
        (lambda: other(noise_variance=np.array([1.0, -1.0, 1.0])), "0 or more"),
        (lambda: other(noise_variance=np.ones(2)), "3 noise variances, got 2"),
        (lambda: other(prior=independent(0.0, 1.0, 3)), "a prior of 2 pixels"),
        (lambda: other(prior=Prior(np.zeros(2), np.array([1.0, np.inf]))), "finite values in the prior"),
        (
            lambda: form_of(Problem(sparse.csr_array((10**6, 10**6)), independent(1.0, 1.0, 10**6), np.ones(10**6))),
            "GB",
        ),
    ],
)
def test_problems_without_an_answer_are_refused(refused: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        refused()
