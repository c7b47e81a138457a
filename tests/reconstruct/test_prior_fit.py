"""Priors and noise fitted to stacks: the evidence by its definition, fits of drawn images, coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse, stats

from ommatid.reconstruct.assumptions import assumptions_for
from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.fitting.prior_fit import Evidence, PriorFit, fit_prior, search
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.methods.method import Execution
from ommatid.reconstruct.prior import Prior, coloured, exponential, exponential_spectrum, independent, prior_of
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import camera, posterior_covariance
from ..frames import recorded, wide, with_apertures

SHAPE = (19, 19)
MATRIX = ideal_matrix(camera())


def evidence(
    image: FloatArray, mean: float, noise: float, seed: int, *, known: float | None = None, prior: Prior | None = None
) -> Evidence:
    """The evidence of what an ideal camera records; `known` is the part of the noise variance that is known."""
    rng = np.random.default_rng(seed)
    recorded = MATRIX @ (image - mean) + rng.normal(0, noise**0.5, MATRIX.shape[0])
    known_noise = np.full(MATRIX.shape[0], 0.0 if known is None else known)
    return Evidence(MATRIX, recorded, known_noise, SHAPE, prior, known == noise)


def drawn(prior: Prior, seed: int) -> FloatArray:
    return prior.mean + prior.apply_root(np.random.default_rng(seed).normal(size=prior.dimension))


@pytest.mark.parametrize("count", [706, 200])
@pytest.mark.parametrize("kind", ["fitted", "independent", "correlated"])
def test_the_evidence_is_the_density_of_the_measurements(kind: str, count: int) -> None:
    """Its value against the multivariate normal density, its gradient against differences."""
    prior = {
        "fitted": None,
        "independent": independent(0.0, 40.0, 361),
        "correlated": exponential(0.0, 40.0, SHAPE, 4.0),
    }[kind]
    whole = evidence(drawn(exponential(0.0, 50.0, SHAPE, 3.0), 0), 0.0, 2.0, 1, known=0.5, prior=prior)
    part = replace(whole, matrix=MATRIX[:count], residual=whole.residual[:count], known_noise=whole.known_noise[:count])
    at = np.log([40.0, 4.0, 1.5]) if prior is None else np.log([1.5])
    actual = exponential(0.0, 40.0, SHAPE, 4.0) if prior is None else prior
    root = np.diag(actual.root) if actual.independent else actual.root
    covariance = (MATRIX[:count] @ root) @ (MATRIX[:count] @ root).T + 2.0 * np.eye(count)
    density = stats.multivariate_normal(np.zeros(count), covariance).logpdf(part.residual)
    value, slope = part.score(at)
    assert value == pytest.approx(-float(density) - count / 2 * np.log(2 * np.pi), rel=1e-9)
    steps = 1e-4 * np.eye(at.size)
    differences = [(part.score(at + step)[0] - part.score(at - step)[0]) / 2e-4 for step in steps]
    assert slope == pytest.approx(differences, rel=1e-5)


def test_tiles_share_the_measurements_out() -> None:
    """Each measurement counts for the one tile that holds all it sees; together they are a camera of smaller images."""
    whole = evidence(drawn(independent(0.0, 9.0, 361), 0), 0.0, 1.0, 0)
    assert whole.blocks(19) == [whole]
    blocks = whole.blocks(10)
    assert [block.shape for block in blocks] == [(10, 10), (10, 9), (9, 10), (9, 9)]
    assert sum(block.residual.size for block in blocks) < whole.residual.size
    for block in blocks:
        np.testing.assert_allclose(block.matrix.sum(axis=1), 1.0)
    correlated = Evidence(MATRIX, whole.residual, whole.known_noise, SHAPE, exponential(0.0, 9.0, SHAPE, 2.0), False)
    corner = correlated.blocks(10)[0].prior
    assert corner is not None
    whole_prior, first = exponential(0.0, 9.0, SHAPE, 2.0), np.arange(361).reshape(SHAPE)[:10, :10].ravel()
    marginal = (whole_prior.root @ whole_prior.root.T)[np.ix_(first, first)]
    assert corner.root @ corner.root.T == pytest.approx(marginal)


KNOWN = [
    (3000.0, 8.0, 1.0),
    *(pytest.param(3000.0, 8.0, noise, marks=pytest.mark.slow) for noise in (400.0, 100.0, 1e-2, 1e-6)),
    *(pytest.param(50.0, 3.0, noise, marks=pytest.mark.slow) for noise in (1.0, 1e-2, 1e-6)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("variance", "length", "noise"), KNOWN)
def test_drawn_parameters_are_fitted(noise: float, variance: float, length: float) -> None:
    """Within four of their standard deviations, from images that noise almost hides to those that it hardly touches."""
    fit = fit_prior(evidence(drawn(exponential(0.0, variance, SHAPE, length), 2), 0.0, noise, 3))
    assert not fit.doubtful
    assert fit.measurements == 706
    values = np.array([fit.variance, fit.length, fit.noise_variance], dtype=float)
    assert np.abs(np.log(values / (variance, length, noise)) / fit.spread).max() < 4


@pytest.mark.slow
def test_noise_is_fitted_with_a_known_prior() -> None:
    """With the prior that the images are drawn from."""
    for prior in (
        independent(0.0, 100.0, 361),
        prior_of(PriorTable(kind="power", variance=100.0, mean=0.0), SHAPE, 1.0),
    ):
        fit = fit_prior(evidence(drawn(prior, 4), 0.0, 2.0, 5, prior=prior))
        assert (fit.variance, fit.length) == (None, None)
        assert fit.noise_variance is not None
        assert abs(np.log(fit.noise_variance / 2.0)) < 4 * fit.spread[0]


def test_the_prior_is_fitted_with_known_noise() -> None:
    fit = fit_prior(evidence(drawn(exponential(0.0, 400.0, SHAPE, 3.0), 6), 0.0, 1.0, 7, known=1.0))
    assert fit.noise_variance is None
    values = np.array([fit.variance, fit.length], dtype=float)
    assert np.abs(np.log(values / (400.0, 3.0)) / fit.spread).max() < 4


def whitened(prior: Prior, noise: float, whole: Evidence, image: FloatArray) -> float:
    """The squared error over its expectation: e^T P^-1 e / N."""
    problem = Problem(MATRIX, prior, np.full(MATRIX.shape[0], noise))
    result = estimate(problem, whole.residual + MATRIX @ prior.mean)
    covariance = posterior_covariance(result.form)
    error = result.image - image
    return float(error @ np.linalg.solve(covariance, error)) / 361


@pytest.mark.slow
def test_coverage_with_a_fitted_prior() -> None:
    """With the true prior the whitened error has its expectation; with a fitted one it exceeds that by 5 % at most.

    Both within the standard error of fourteen images: chi-squared of 14 x 361 values, and of the sample.
    """
    prior = exponential(127.5, 900.0, SHAPE, 4.0)
    ratios: list[tuple[float, float]] = []
    for seed in range(14):
        image = drawn(prior, 10 + seed)
        whole = evidence(image, 127.5, 4.0, 100 + seed)
        fit = fit_prior(whole)
        fitted = exponential(127.5, fit.variance or 0.0, SHAPE, fit.length or 0.0)
        ratios.append((whitened(fitted, fit.noise_variance or 0.0, whole, image), whitened(prior, 4.0, whole, image)))
    by_fit, by_truth = np.mean(ratios, axis=0)
    chance = np.std(ratios, axis=0, ddof=1)[0] / len(ratios) ** 0.5
    assert chance < 0.04
    assert by_fit == pytest.approx(1, abs=0.05 + 2.6 * chance)
    assert by_truth == pytest.approx(1, abs=4 * (2 / 361 / 14) ** 0.5)


@pytest.mark.slow
def test_fits_without_information_are_refused_or_doubtful() -> None:
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
    """Footprints of 18 x 18 pixels in the middle of the image fit into no tile of 24; all are used nevertheless."""
    wide = ideal_matrix(camera((30, 30), (("1/18", [8, 8], [1, 1]),)))
    prior = independent(0.0, 900.0, 900)
    residual = wide @ drawn(prior, 0) + np.random.default_rng(1).normal(size=64)
    fit = fit_prior(Evidence(sparse.csr_array(wide), residual, np.zeros(64), (30, 30), prior, False))
    assert fit.measurements == 64


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_prior_fits_at_the_noise_of_the_paper(seed: int) -> None:
    """A search over the whole range steps to its bounds there, finds no evidence, and returns where it began."""
    shape = (14, 14)
    matrix = ideal_matrix(camera(shape, (("1/3", [3, 3], "fit"), ("1/5", [5, 5], "fit"), ("1/4", [4, 4], "fit"))))
    rng = np.random.default_rng([seed, 5])
    residual = matrix @ (exponential(0.0, 1000.0, shape, 4.0).root @ rng.normal(size=shape[0] * shape[1]))
    residual = residual + 1e-2 * rng.normal(size=residual.size)
    whole = Evidence(matrix, residual, np.full(residual.size, 1e-4), shape, None, True)
    fit = fit_prior(whole)
    assert fit.variance is not None
    assert fit.length is not None
    assert not fit.doubtful
    assert whole.score(np.log([fit.variance, fit.length]))[0] <= whole.score(np.log([1000.0, 4.0]))[0]
    assert np.abs(np.log(np.array([fit.variance, fit.length]) / (1000.0, 4.0)) / fit.spread).max() < 4


def test_a_search_keeps_out_of_where_no_evidence_is() -> None:
    """The minimum of a steep valley beside a region without a score, found to a hundredth of its width."""

    def score(point: FloatArray) -> tuple[float, FloatArray]:
        if point[0] > 6 or point.sum() > 9:
            return float("inf"), np.zeros(2)
        across, along = point[0] - point[1] - 3, point.sum() - 7
        slope = np.array([2e4 * across + 20 * along, -2e4 * across + 20 * along])
        return 1e4 * across**2 + 10 * along**2 - 2000, slope

    result = search(score, [np.array([-10.0, 4.0]), np.array([5.9, 3.0])], [(-30.0, 30.0), (-30.0, 30.0)])
    assert result.is_maximum
    assert not result.on_bound
    assert np.abs(result.point - (5.0, 2.0)).max() < 0.01 * max(result.spread) + 1e-3
    assert result.spread == pytest.approx([(1 / 80 + 1 / 8e4) ** 0.5] * 2, rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("noise_known", [True, False])
def test_an_image_that_no_measurement_shows_makes_the_fit_doubtful(noise_known: bool) -> None:
    """A checkerboard under averages of 2 x 2 and 4 x 4 pixels is grey: the fit would promise almost no error."""
    shape = (12, 12)
    matrix = ideal_matrix(camera(shape, (("1/2", [2, 2], "fit"), ("1/4", [4, 4], "fit"))))
    board = 255.0 * (np.indices(shape).sum(axis=0) % 2).ravel()
    residual = matrix @ (board - 127.5) + 1e-2 * np.random.default_rng(0).normal(size=matrix.shape[0])
    known = np.full(residual.size, 1e-4 if noise_known else 0.0)
    assert fit_prior(Evidence(matrix, residual, known, shape, None, noise_known)).doubtful


def test_a_prior_is_fitted_to_large_images_behind_kernels() -> None:
    """No tile holds a whole kernel: a window in the middle does, and its light from beside it counts as noise."""
    shape = 67, 65
    described = with_apertures(wide(shape, noise={"variance": 1e-2}, prior={"kind": "fit"}))
    layout = derive(described)
    spectrum = 900.0 * exponential_spectrum(shape, 6.0)
    truth = 127.5 + coloured(spectrum, np.random.default_rng(3).normal(size=shape)).ravel()
    model = ideal_model(described, layout)
    stack = recorded(described, truth, 1e-2, matrix=model.as_linear_operator())
    assumed = assumptions_for(stack, model, choose_method(described, layout, exact=True), Execution())
    assert assumed.fit is not None
    logs = np.log([(assumed.fit.variance or 0) / 900.0, (assumed.fit.length or 0) / 6.0])
    assert np.abs(logs / np.array(assumed.fit.spread)).max() < 4
