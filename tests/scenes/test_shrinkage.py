"""Moderated variances against simulations in which the truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.scenes.shrinkage import shrink_variances


@pytest.mark.parametrize("freedom", [3, 15, 63])
@pytest.mark.parametrize("prior_freedom", [3.0, 8.0, 40.0])
def test_sums_come_out_right_even_under_weights_from_the_same_variances(freedom: int, prior_freedom: float) -> None:
    """Inverse-variance weights favour what was underestimated; the moderated variances allow for it, plain ones not."""
    rng = np.random.default_rng(3)
    true = prior_freedom / rng.chisquare(prior_freedom, 20_000)
    seen = true * rng.chisquare(freedom, true.size) / freedom
    moderated = shrink_variances(seen, freedom + 1)
    weights = 1 / moderated**2
    assert np.sum(weights * moderated) / np.sum(weights * true) == pytest.approx(1, abs=0.05)
    naive = 1 / seen**2
    assert np.sum(naive * seen) / np.sum(naive * true) < 0.9 or freedom == 63


def test_they_are_closer_to_the_truth_than_the_plain_ones() -> None:
    rng = np.random.default_rng(4)
    true = 10 / rng.chisquare(10, 5000)
    seen = true * rng.chisquare(15, true.size) / 15
    assert np.mean(np.log(shrink_variances(seen, 16) / true) ** 2) < 0.8 * np.mean(np.log(seen / true) ** 2)


def test_equal_things_get_one_variance_and_scale_goes_through() -> None:
    rng = np.random.default_rng(5)
    seen = 7 * rng.chisquare(15, 4000) / 15
    moderated = shrink_variances(seen, 16)
    assert moderated.std() < 0.1 * seen.std()
    assert moderated.mean() == pytest.approx(7, rel=0.03)
    np.testing.assert_allclose(shrink_variances(1e-12 * seen, 16), 1e-12 * moderated, rtol=1e-6)


def test_too_few_or_no_variances_pass_unchanged() -> None:
    np.testing.assert_array_equal(shrink_variances(np.array([3.0]), 16), [3.0])
    np.testing.assert_array_equal(shrink_variances(np.zeros(5), 16), np.zeros(5))


@pytest.mark.parametrize(("spread", "much"), [(0.5, 1.05), (1.0, 1.1), (2.0, 1.25)])
def test_populations_that_are_no_inverse_chi_squared(spread: float, much: float) -> None:
    """Lognormal true variances: sums may come out too large, by a stated much, but not too small."""
    rng = np.random.default_rng(6)
    ratios: list[float] = []
    for _ in range(50):
        true = np.exp(spread * rng.normal(size=225))
        seen = true * rng.chisquare(15, true.size) / 15
        ratios.append(float(shrink_variances(seen, 16).sum() / true.sum()))
    assert 0.97 < np.mean(ratios) < much
