"""The estimator's silent losses: problems at the limits of float64 against exact answers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.expected_error import bias_of, variance_of_sum
from ommatid.reconstruct.forms.cholesky import covariance
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.errors import InputError
from ommatid.stability.exact_answer import exact_answer

from ..benchmarks.nasty import FAMILIES, SILENT, assess, relative_error
from ..examples import not_none, slow

REFUSED = -1.0  # in place of an error
EACH, FEW = 334, 6  # problems of every family: 5,010 of the long form
# Those whose measurements without noise, or whose digits, float64 cannot tell apart.
MOST_REFUSED = {"nearly equal rows, noise-free": 1.0, "contradiction": 0.65, "singular prior": 0.5}


@pytest.mark.parametrize("each", [FEW, slow(EACH)])
def test_no_random_problem_is_silently_wrong(each: int) -> None:
    """Every one is right to its stated bound, or refused; few families refuse half, within 3 standard errors."""
    for family in FAMILIES:
        outcomes = [assess(family, seed) for seed in range(each)]
        assert [outcome for outcome in outcomes if outcome.outcome == SILENT] == []
        refused = sum(outcome.outcome == "refused" for outcome in outcomes) / each
        share = MOST_REFUSED.get(family, 0.45)
        assert refused <= share + 3 * (share * (1 - share) / each) ** 0.5, family


def test_a_bound_that_is_small_by_chance_does_not_count() -> None:
    """A problem of 2 x 2 whose first refinement happens to find 1e-17 where 1e-7 is left."""
    matrix = np.array([[-0.24424669002776175, -0.21412895875953997], [-0.24424669002776692, -0.21412895875953805]])
    prior = Prior(np.array([127.5, 127.5]), np.array([5906.196726545196, 9.316377290829726]))
    noise = np.array([7.4696738971771692e-15, 1.4598793799778568e-22])
    recorded = np.array([-2111.8053177040797, -2111.805317724425])
    assert _excess(Problem(sparse.csr_array(matrix), prior, noise), recorded) <= 1


def _excess(problem: Problem, recorded: np.ndarray) -> float:
    """Return the error of an estimate over the largest that its bound allows, or REFUSED."""
    try:
        solution = estimate(problem, recorded)
    except InputError:
        return REFUSED
    exact = exact_answer(problem, recorded)
    bound = not_none(solution.solver.bound)
    return relative_error(solution.coefficients, exact.coefficients) / max(10 * bound, 1e-9)


@pytest.mark.parametrize("size", [1e300, 1e150, 1e-100])
def test_entries_at_the_ends_of_float64(size: float) -> None:
    """A bound that is NaN is none: the answer is right, or refused with a sentence."""
    index = np.arange(3)
    problem = Problem(
        sparse.csr_array(size / (index[:, None] + index + 1.0)), independent(127.5, 5461.25, 3), np.full(3, 1e-4)
    )
    recorded = size * np.array([200.0, 150.0, 120.0])
    assert _excess(problem, recorded) <= 1


@pytest.mark.parametrize("mean", [0.0, 127.5, 1e4, 1e8, 1e10])
def test_contradictions_are_relative_to_the_image(mean: float) -> None:
    """Readings 1 and 2 of one pixel without noise contradict each other however large the prior's mean is."""
    twice = sparse.csr_array(np.ones((2, 1)))
    problem = Problem(twice, Prior(np.array([mean]), np.array([max(mean, 73.9)])), np.zeros(2))
    with pytest.raises(InputError, match="contradict one another"):
        estimate(problem, np.array([1.0, 2.0]))
    assert estimate(problem, np.array([1.5, 1.5])).image == pytest.approx([1.5], abs=1e-15 * max(mean, 1.5))


def test_measurements_are_refused_that_may_contradict_one_another_or_determine_the_image() -> None:
    """Two rows without noise that differ by their rounding, and a root of a known mean whose rows add up to 7e-15.

    In exact numbers they determine the mean, far from what the prior says, by a signal of 1e-30.
    """
    row = np.array([0.6270104608342295, 0.7383332573230119, 0.6146593538497589])
    prior = Prior(np.full(3, 127.5), 73.9 * (np.eye(3) - 1 / 3))
    problem = Problem(sparse.csr_array(np.stack([row, row + 4 * 2.0**-53])), prior, np.zeros(2))
    with pytest.raises(InputError, match="no form of the estimator"):
        estimate(problem, np.array([265.1198415482231, 265.1198415482233]))


@pytest.mark.parametrize("noise", [1e-6, 1e-20, 1e-30])
def test_error_bars_keep_their_digits(noise: float) -> None:
    """80 pixels, each seen by its own measurement: variance and bias of a sum in closed form."""
    count = 80
    problem = Problem(sparse.csr_array(np.eye(count)), independent(0.0, 4.0, count), np.full(count, noise))
    form = covariance(problem)
    posterior = noise / (1 + noise / 4)
    weights = np.full(count, 1 / count)
    assert variance_of_sum(form, weights, problem.noise_variance) == pytest.approx(posterior / count, rel=1e-9)
    difference = np.random.default_rng(0).normal(size=count)
    share = (noise / 4) / (1 + noise / 4)
    np.testing.assert_allclose(bias_of(form, difference), share * difference, rtol=1e-9)


def test_the_rounding_of_a_nearly_singular_prior_counts() -> None:
    """Pixels correlated over 1e9 of them: their covariance is known to 1e-16, the difference of two of them to 1e-7."""
    matrix = sparse.csr_array(np.random.default_rng(0).uniform(0, 1, (13, 9)))
    recorded = matrix @ np.full(9, 130.0)
    for length, answered in ((1e3, True), (1e9, False)):
        problem = Problem(matrix, exponential(127.5, 5461.25, (3, 3), length), np.full(13, 1e-6))
        if answered:
            assert estimate(problem, recorded).solver.variance_bound < 1e-8
            continue
        with pytest.raises(InputError, match="nearly singular"):
            estimate(problem, recorded)
        assert estimate(problem, recorded, 1e-4).solver.variance_bound > 1e-7
