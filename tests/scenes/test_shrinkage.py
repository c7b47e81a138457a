"""Shrunk variances against simulations with known true variances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ommatid.scenes.shrinkage import posterior_variances, posterior_variances_among, shrink_variances


@pytest.mark.parametrize("freedom", [3, 15, 63])
@pytest.mark.parametrize("prior_freedom", [3.0, 8.0, 40.0])
def test_sums_are_unbiased_under_weights_from_the_same_variances(freedom: int, prior_freedom: float) -> None:
    """Inverse-variance weights favour underestimates; shrunk variances compensate for that, plain ones do not.

    The tolerance is five standard errors of the ratio of the two sums, plus twice the prior's fitted parameters' own
    error, of relative order sqrt(2 / n).
    """
    rng = np.random.default_rng(3)
    true = prior_freedom / rng.chisquare(prior_freedom, 20_000)
    sample = true * rng.chisquare(freedom, true.size) / freedom
    shrunk = shrink_variances(sample, freedom + 1)
    weights = 1 / shrunk**2
    ratio = np.sum(weights * shrunk) / np.sum(weights * true)
    standard_error = np.sqrt(np.sum((weights * (shrunk - ratio * true)) ** 2)) / np.sum(weights * true)
    assert ratio == pytest.approx(1, abs=5 * standard_error + 2 * np.sqrt(2 / true.size))
    plain = 1 / sample**2
    assert np.sum(plain * sample) / np.sum(plain * true) < 0.9 or freedom == 63


def test_equal_variances_become_one_value_that_scales_with_them() -> None:
    """The mean of n variances of 15 degrees of freedom has the relative standard error sqrt(2 / 15 n)."""
    rng = np.random.default_rng(5)
    sample = 7 * rng.chisquare(15, 4000) / 15
    shrunk = shrink_variances(sample, 16)
    assert shrunk.std() < 0.1 * sample.std()
    assert shrunk.mean() == pytest.approx(7, rel=5 * np.sqrt(2 / 15 / sample.size))
    np.testing.assert_allclose(shrink_variances(1e-12 * sample, 16), 1e-12 * shrunk, rtol=1e-6)


@pytest.mark.parametrize("ratio", [1.0, 1e6])
def test_few_rare_events_leave_what_never_varied_without_variance(ratio: float) -> None:
    """Two of 1000 quantities were hit by a ray from elsewhere: the sum of variances stays that of these two."""
    sample = np.zeros(1000)
    sample[[3, 500]] = 1.0, ratio
    shrunk = shrink_variances(sample, 16)
    assert np.flatnonzero(shrunk).tolist() == [3, 500]
    assert shrunk.sum() < 2 * sample.sum()


def test_posterior_variances_are_means_of_a_law_that_is_not_given() -> None:
    """Against Bayes' rule with the law of the true variances, two values, which the other form of shrinkage misses."""
    rng, values, shares = np.random.default_rng(8), np.array([1e-3, 1.0]), np.array([0.7, 0.3])
    sample = rng.choice(values, size=100_000, p=shares) * rng.chisquare(15, 100_000) / 15
    likelihoods = shares * stats.chi2.pdf(15 * sample[:, None] / values, 15) / values
    exact = likelihoods @ values / likelihoods.sum(axis=1)
    error, shrunk = (np.abs(f(sample, 16) / exact - 1).mean() for f in (posterior_variances, shrink_variances))
    assert error < 0.2 * shrunk


def test_posterior_variances_are_unbiased_in_every_group_of_a_smooth_law() -> None:
    """The tolerance is five standard errors of a group's mean, and 2 % for the width of the kernel."""
    rng = np.random.default_rng(8)
    true = 10 ** rng.uniform(-6, 1, 100_000)
    means = posterior_variances(true * rng.chisquare(15, true.size) / 15, 16)
    for group in np.array_split(np.argsort(means), 20):
        ratio = true[group] / means[group]
        assert ratio.mean() == pytest.approx(1, abs=0.02 + 5 * ratio.std() / group.size**0.5)


def test_posterior_variances_of_few_are_shrunk_and_of_none_are_zero() -> None:
    rng = np.random.default_rng(9)
    few = rng.chisquare(15, 200) / 15
    np.testing.assert_array_equal(posterior_variances(few, 16), shrink_variances(few, 16))
    many = np.where(np.arange(20_000) % 2 == 0, rng.chisquare(15, 20_000), 0.0)
    np.testing.assert_array_equal(posterior_variances(np.zeros(5000), 16), np.zeros(5000))
    assert np.isfinite(posterior_variances(many, 16)).all()
    scaled = posterior_variances(1e-200 * many, 16)
    np.testing.assert_allclose(scaled, 1e-200 * posterior_variances(many, 16), rtol=1e-2)


def test_what_the_neighbours_say_corrects_variances_place_by_place() -> None:
    """Where variances are large on average, a small sample is more often an underestimate than elsewhere."""
    rng = np.random.default_rng(10)
    typical = np.repeat([0.1, 1.0, 10.0], 20_000)
    true = typical * 10 / rng.chisquare(10, typical.size)
    sample = true * rng.chisquare(15, true.size) / 15
    for means, error in (
        (posterior_variances(sample, 16), 0.2),
        (posterior_variances_among(sample, typical, 16), 0.02),
    ):
        weights = 1 / means
        ratios = [
            (weights * true)[typical == one].sum() / (weights * means)[typical == one].sum() for one in (0.1, 10.0)
        ]
        assert max(np.abs(np.array(ratios) - 1)) < error
        assert error < 0.1 or max(np.abs(np.array(ratios) - 1)) > 0.03
