"""Eq. 4 in all its forms against other methods: limits, laws, a Bayesian by brute force; which form runs, and why."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from ommatid.reconstruct.estimator.certificate import variance_error
from ommatid.reconstruct.estimator.estimate import FORMS, estimate, factorise
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.reconstruct.forms.information import information
from ommatid.reconstruct.forms.square_root_information import square_root_information
from ommatid.reconstruct.prior import Prior
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.errors import InputError
from ommatid.simulate.ideal import ideal_matrix

from ..examples import THREE, camera

Vector = NDArray[np.float64]


def problem(seed: int = 0, m: int = 7, n: int = 5, *, correlated: bool = False) -> Problem:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) if correlated else np.sqrt(rng.uniform(1, 50, n))
    matrix = sparse.csr_array(rng.normal(size=(m, n)))
    return Problem(matrix, Prior(rng.normal(size=n), root), rng.uniform(0.1, 2, m))


def tile(lenses: int, noise: float) -> Problem:
    one = camera(lenses=THREE[:lenses])
    prior = Prior(np.full(361, 127.5), np.full(361, 5461.25**0.5))
    return Problem(ideal_matrix(one), prior, np.full(one.measurements, noise))


def one_by_one(known: Problem, g: Vector) -> tuple[Vector, NDArray[np.float64]]:
    """Sequential scalar updates, a Kalman filter without dynamics: it shares no formula with any form."""
    image = known.prior.mean.copy()
    root = known.prior.root
    covariance = np.diag(root**2) if known.prior.independent else root @ root.T
    for row, reading, variance in zip(known.matrix.toarray(), g, known.noise_variance, strict=True):
        direction = covariance @ row
        innovation = row @ direction + variance
        image = image + direction * (reading - row @ image) / innovation
        covariance = covariance - np.outer(direction, direction) / innovation
    return image, covariance


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [(7, 5), (4, 6), (5, 5), (1, 1)])
@pytest.mark.parametrize("correlated", [False, True])
def test_against_conditioning_a_joint_gaussian_one_measurement_at_a_time(
    form: str, shape: tuple[int, int], correlated: bool
) -> None:
    known = problem(3, *shape, correlated=correlated)
    g = np.random.default_rng(1).normal(size=shape[0])
    image, covariance = one_by_one(known, g)
    found = estimate(known, g, form)
    np.testing.assert_allclose(found.image, image, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(found.form.variance(), np.diag(covariance), rtol=1e-8)
    some = np.random.default_rng(2).normal(size=(shape[1], 3))
    np.testing.assert_allclose(found.form.covariance(some), covariance @ some, rtol=1e-8, atol=1e-9)
    multipliers = (g - known.matrix @ image) / known.noise_variance
    np.testing.assert_allclose(found.multipliers, multipliers, rtol=1e-7, atol=1e-8)


@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 9), st.booleans())
@settings(max_examples=60, deadline=None, derandomize=True)
def test_all_forms_agree(seed: int, m: int, n: int, correlated: bool) -> None:
    known = problem(seed, m, n, correlated=correlated)
    g = np.random.default_rng(seed + 1).normal(size=m)
    first, *others = (estimate(known, g, form, 1e-6) for form in FORMS)
    for other in others:
        np.testing.assert_allclose(other.image, first.image, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.form.variance(), first.form.variance(), rtol=1e-5)
        columns = [found.form.columns(np.arange(n)) for found in (first, other)]
        np.testing.assert_allclose(columns[1][0], columns[0][0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(columns[1][1], columns[0][1], rtol=1e-5, atol=1e-6)


@given(st.integers(0, 10**6))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_more_measurements_never_raise_the_expected_error(seed: int) -> None:
    known = problem(seed, 8, 6)
    fewer = Problem(known.matrix[:5], known.prior, known.noise_variance[:5])
    assert (factorise(known)[0].variance() <= factorise(fewer)[0].variance() * (1 + 1e-9)).all()


def test_limits() -> None:
    """Much noise: the prior. Little noise: the image, where H sees it. The identity: one weight a pixel."""
    known = problem(3, 9, 5)
    image = np.random.default_rng(4).normal(size=5)
    blind = Problem(known.matrix, known.prior, known.noise_variance * 1e12)
    assert factorise(blind)[0].variance() == pytest.approx(known.prior.variance, rel=1e-6)
    for factor in (1e-8, 0.0):
        sharp = Problem(known.matrix, known.prior, known.noise_variance * factor)
        assert estimate(sharp, known.matrix @ image).image == pytest.approx(image, rel=1e-6)
    identity = Problem(sparse.csr_array(np.eye(4)), Prior(np.full(4, 4.0), np.full(4, 3.0**0.5)), np.full(4, 1.0))
    found = estimate(identity, np.full(4, 8.0))
    assert found.image == pytest.approx(np.full(4, 4 + 4 * 3 / 4))
    assert found.form.variance() == pytest.approx(np.full(4, 3 / 4))


@pytest.mark.parametrize(
    ("lenses", "noise", "method", "failed"),
    [
        (3, 1e-2, "information", []),
        (2, 1e-2, "information", []),
        (2, 1e-6, "covariance", ["information"]),
        (2, 1e-12, "svd", ["information", "covariance"]),
        (1, 1e-2, "covariance", []),
    ],
)
def test_the_next_sturdier_form_runs_where_the_bound_misses(
    lenses: int, noise: float, method: str, failed: list[str]
) -> None:
    """Shape decides where to begin, the certificate where to end; every form that was given up says why."""
    known = tile(lenses, noise)
    rng = np.random.default_rng(0)
    g = known.matrix @ rng.uniform(0, 255, 361) + rng.normal(0, noise**0.5, known.measurements)
    solver = estimate(known, g).solver
    assert solver.method == method
    assert [name for name, _ in solver.tried] == failed
    assert all(reason for _, reason in solver.tried)
    assert solver.bound is not None
    assert solver.bound <= 1e-8
    assert solver.variance_bound <= 1e-8
    assert solver.digits >= 8


def test_noise_of_any_size_side_by_side_takes_a_form_that_keeps_rows_apart() -> None:
    known = problem(5, 9, 6)
    noise = np.geomspace(1e-12, 1e6, 9)
    spread = Problem(known.matrix, known.prior, noise)
    found = estimate(spread, np.arange(9.0))
    image, _ = one_by_one(Problem(known.matrix[::-1], known.prior, noise[::-1]), np.arange(9.0)[::-1])
    assert found.image == pytest.approx(image, rel=1e-6)
    assert "svd" not in [found.solver.method, *(name for name, _ in found.solver.tried)]


def test_a_certificate_that_is_not_fooled() -> None:
    """A factorisation of another problem, one with a twentieth more deviation beforehand, must not pass for right."""
    known = tile(3, 1e-4)
    honest = square_root_information(known)
    spoilt_problem = Problem(known.matrix, Prior(known.prior.mean, known.prior.root * 1.05), known.noise_variance)
    spoilt = square_root_information(spoilt_problem)
    liar = type(honest)(known, spoilt.condition, spoilt.normal)
    assert variance_error(honest, ExactResiduals(known)) < 1e-12
    assert variance_error(liar, ExactResiduals(known)) > 0.05
    weak = information(tile(2, 1e-6))
    assert variance_error(weak, ExactResiduals(weak.problem)) > 1e-9


@pytest.mark.parametrize("form", [form for form in FORMS if form != "dual"])
def test_what_a_form_cannot_do_is_refused(form: str) -> None:
    """Twice the same row without noise, and noise beyond rounding."""
    matrix = sparse.csr_array(np.ones((3, 2)))
    exact = Problem(matrix, Prior(np.zeros(2), np.ones(2)), np.zeros(3))
    with pytest.raises(InputError, match=f"no form .* reaches .*{form}: "):
        estimate(exact, np.ones(3), form)


def test_contradictions_and_numbers_that_are_none_are_refused() -> None:
    matrix = sparse.csr_array(np.ones((3, 2)))
    exact = Problem(matrix, Prior(np.zeros(2), np.ones(2)), np.zeros(3))
    with pytest.raises(InputError, match="contradict one another"):
        estimate(exact, np.array([1.0, 2.0, 3.0]))
    with pytest.raises(InputError, match="dead pixels"):
        estimate(exact, np.array([1.0, np.nan, 3.0]))
    with pytest.raises(InputError, match="noise variances"):
        Problem(matrix, exact.prior, np.array([1.0, np.nan, 1.0]))
    with pytest.raises(InputError, match="0 or more"):
        Problem(matrix, exact.prior, np.array([1.0, -1.0, 1.0]))
    with pytest.raises(InputError, match="the prior"):
        Problem(matrix, Prior(np.zeros(2), np.array([1.0, np.inf])), np.ones(3))


def test_too_large_a_problem_is_refused_before_memory_is_asked_for() -> None:
    matrix = sparse.csr_array((10**6, 10**6))
    with pytest.raises(InputError, match="GB"):
        factorise(Problem(matrix, Prior(np.ones(10**6), np.ones(10**6)), np.ones(10**6)))
