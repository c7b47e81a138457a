"""Priors and noise found from stacks: the likelihood by its definition, what is found in what was drawn, coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse, stats

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.fitting.evidence import Evidence
from ommatid.reconstruct.fitting.prior_fit import PriorFit, fit_prior
from ommatid.reconstruct.prior import Prior, exponential, independent, prior_of
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.errors import InputError
from ommatid.scenes.formats.picture import load
from ommatid.scenes.tables.estimation import PriorTable as Table
from ommatid.simulate.ideal import ideal_matrix

from ..examples import camera, posterior_covariance, scene

Vector = NDArray[np.float64]

SHAPE = (19, 19)
MATRIX = ideal_matrix(camera())


def evidence(
    image: Vector, mean: float, noise: float, seed: int, *, known: float | None = None, prior: Prior | None = None
) -> Evidence:
    """What a perfect camera records; `known` of the noise is told, all of it or a part."""
    rng = np.random.default_rng(seed)
    recorded = MATRIX @ (image - mean) + rng.normal(0, noise**0.5, MATRIX.shape[0])
    told = np.full(MATRIX.shape[0], 0.0 if known is None else known)
    return Evidence(MATRIX, recorded, told, SHAPE, prior, known == noise)


def drawn(prior: Prior, seed: int) -> Vector:
    return prior.mean + prior.apply_root(np.random.default_rng(seed).normal(size=prior.dimension))


@pytest.mark.parametrize("some", [706, 200])
@pytest.mark.parametrize("kind", ["found", "independent", "correlated"])
def test_the_likelihood_is_that_of_the_measurements(kind: str, some: int) -> None:
    """Its value against the multivariate normal density, its gradient against differences."""
    prior = {
        "found": None,
        "independent": independent(0.0, 40.0, 361),
        "correlated": exponential(0.0, 40.0, SHAPE, 4.0),
    }[kind]
    all_of_it = evidence(drawn(exponential(0.0, 50.0, SHAPE, 3.0), 0), 0.0, 2.0, 1, known=0.5, prior=prior)
    one = replace(
        all_of_it,
        matrix=MATRIX[:some],
        residual=all_of_it.residual[:some],
        known_noise=all_of_it.known_noise[:some],
    )
    at = np.log([40.0, 4.0, 1.5]) if prior is None else np.log([1.5])
    taken = exponential(0.0, 40.0, SHAPE, 4.0) if prior is None else prior
    root = np.diag(taken.root) if taken.independent else taken.root
    covariance = (MATRIX[:some] @ root) @ (MATRIX[:some] @ root).T + 2.0 * np.eye(some)
    density = stats.multivariate_normal(np.zeros(some), covariance).logpdf(one.residual)
    value, slope = one.score(at)
    assert value == pytest.approx(-float(density) - some / 2 * np.log(2 * np.pi), rel=1e-9)
    steps = 1e-4 * np.eye(at.size)
    differences = [(one.score(at + step)[0] - one.score(at - step)[0]) / 2e-4 for step in steps]
    assert slope == pytest.approx(differences, rel=1e-5)


def test_tiles_share_the_measurements_out() -> None:
    """Each measurement counts for the one tile that holds all it sees; together they are a camera of smaller images."""
    one = evidence(drawn(independent(0.0, 9.0, 361), 0), 0.0, 1.0, 0)
    assert one.blocks(19) == [one]
    blocks = one.blocks(10)
    assert [block.shape for block in blocks] == [(10, 10), (10, 9), (9, 10), (9, 9)]
    assert sum(block.residual.size for block in blocks) < one.residual.size
    for block in blocks:
        np.testing.assert_allclose(block.matrix.sum(axis=1), 1.0)
    correlated = Evidence(MATRIX, one.residual, one.known_noise, SHAPE, exponential(0.0, 9.0, SHAPE, 2.0), False)
    corner = correlated.blocks(10)[0].prior
    assert corner is not None
    assert corner.root @ corner.root.T == pytest.approx(
        exponential(0.0, 9.0, (10, 10), 2.0).root @ exponential(0.0, 9.0, (10, 10), 2.0).root.T
    )


# Signal and noise: of images that noise nearly drowns to those that it hardly touches.
KNOWN = [(3000.0, 8.0, noise) for noise in (400.0, 100.0, 1.0, 1e-2, 1e-6)] + [
    (50.0, 3.0, noise) for noise in (1.0, 1e-2, 1e-6)
]


@pytest.mark.parametrize(("variance", "length", "noise"), KNOWN)
def test_what_the_stack_was_drawn_from_is_found(noise: float, variance: float, length: float) -> None:
    """Within four of its own standard deviations, wherever signal drowns noise or noise does not drown it."""
    found = fit_prior(evidence(drawn(exponential(0.0, variance, SHAPE, length), 2), 0.0, noise, 3))
    assert not found.doubtful
    assert found.measurements == 706
    values = np.array([found.variance, found.length, found.noise_variance], dtype=float)
    assert np.abs(np.log(values / (variance, length, noise)) / found.spread).max() < 4


def test_noise_under_a_prior_that_is_given() -> None:
    """Under the prior in use, not under another one: white images have no correlation length to be found."""
    for prior in (independent(0.0, 100.0, 361), prior_of(Table(kind="power", variance=100.0, mean=0.0), SHAPE, 1.0)):
        found = fit_prior(evidence(drawn(prior, 4), 0.0, 2.0, 5, prior=prior))
        assert (found.variance, found.length) == (None, None)
        assert found.noise_variance is not None
        assert abs(np.log(found.noise_variance / 2.0)) < 4 * found.spread[0]


def test_the_prior_under_noise_that_is_known() -> None:
    found = fit_prior(evidence(drawn(exponential(0.0, 400.0, SHAPE, 3.0), 6), 0.0, 1.0, 7, known=1.0))
    assert found.noise_variance is None
    values = np.array([found.variance, found.length], dtype=float)
    assert np.abs(np.log(values / (400.0, 3.0)) / found.spread).max() < 4


def whitened(prior: Prior, noise: float, one: Evidence, image: Vector) -> float:
    """The squared error in units of its expectation, as a whole: e^T P^-1 e / N."""
    problem = Problem(MATRIX, prior, np.full(MATRIX.shape[0], noise))
    result = estimate(problem, one.residual + MATRIX @ prior.mean)
    covariance = posterior_covariance(result.form)
    error = result.image - image
    return float(error @ np.linalg.solve(covariance, error)) / 361


def test_coverage_with_a_fitted_prior() -> None:
    """The whitened error is within 5 % of its expectation, as far as fourteen images can tell.

    Forty images of another seed gave 1.028, give or take 0.016, and 1.005 with the true prior.
    """
    prior = exponential(127.5, 900.0, SHAPE, 4.0)
    ratios: list[tuple[float, float]] = []
    for seed in range(14):
        image = drawn(prior, 10 + seed)
        one = evidence(image, 127.5, 4.0, 100 + seed)
        found = fit_prior(one)
        fitted = exponential(127.5, found.variance or 0.0, SHAPE, found.length or 0.0)
        ratios.append((whitened(fitted, found.noise_variance or 0.0, one, image), whitened(prior, 4.0, one, image)))
    by_fit, by_truth = np.mean(ratios, axis=0)
    chance = np.std(ratios, axis=0, ddof=1)[0] / len(ratios) ** 0.5
    assert chance < 0.04
    assert by_fit == pytest.approx(1, abs=0.05 + 2.6 * chance)
    assert by_truth == pytest.approx(1, abs=4 * (2 / 361 / 14) ** 0.5)


def test_a_photograph_gains_from_a_fitted_prior() -> None:
    """At a noise variance of 1 its error falls to a third of that with the paper's prior, at 100 to a fifth."""
    flat = load(scene()).ravel()
    for noise, share in ((1.0, 1 / 3), (100.0, 1 / 5)):
        one = evidence(flat, 127.5, noise, 5)
        found = fit_prior(one)
        assert found.noise_variance == pytest.approx(noise, rel=4 * found.spread[2])
        fitted = exponential(127.5, found.variance or 0.0, SHAPE, found.length or 0.0)
        errors: list[float] = []
        for prior in (fitted, independent(127.5, 5461.25, 361)):
            result = estimate(Problem(MATRIX, prior, np.full(706, noise)), one.residual + MATRIX @ prior.mean)
            errors.append(float(np.mean((result.image - flat) ** 2)))
        assert errors[0] < share * errors[1]


def test_what_cannot_be_found_is_refused_or_doubted() -> None:
    with pytest.raises(InputError, match="10 measurements or more, got 5"):
        fit_prior(Evidence(MATRIX[:5], np.ones(5), np.ones(5), SHAPE, None, True))
    with pytest.raises(InputError, match="without noise; set estimator"):
        fit_prior(Evidence(MATRIX, np.ones(706), np.zeros(706), SHAPE, None, True))
    with pytest.raises(InputError, match="nothing can be fitted"):
        fit_prior(Evidence(MATRIX, np.zeros(706), np.ones(706), SHAPE, None, True))
    flat: PriorFit = fit_prior(
        Evidence(MATRIX, np.random.default_rng(0).normal(size=706), np.full(706, 1.0), SHAPE, None, True)
    )
    assert flat.doubtful or max(flat.spread) > 1 or not np.isfinite(flat.spread).all()


def test_large_footprints_get_larger_tiles() -> None:
    """Sensor pixels of 18 x 18 target pixels in the middle lie whole in no tile of 24: all of them still have a say."""
    wide = ideal_matrix(camera((30, 30), (("1/18", [8, 8], [1, 1]),)))
    prior = independent(0.0, 900.0, 900)
    residual = wide @ drawn(prior, 0) + np.random.default_rng(1).normal(size=64)
    found = fit_prior(Evidence(sparse.csr_array(wide), residual, np.zeros(64), (30, 30), prior, False))
    assert found.measurements == 64
