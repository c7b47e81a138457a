"""Effect of the errors of H: the light that rows lose, the contrast without noise, the attenuation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution, PosteriorOperators, total_variance
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.model_error.attenuation import Attenuation
from ommatid.reconstruct.model_error.contrast import Waves, continued, likeliest_share, true_contrast
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from tests.examples import THREE, Lenses, not_none, scene

BATCHES, SPREAD = 8, 0.02
NOISE = 1e-2
DRAWS = 24


def _exact(lenses: Lenses = THREE) -> Model:
    described = scene(lenses=lenses, noise={"variance": NOISE})
    model = ideal_model(described, derive(described))
    return replace(model, stored=ideal_matrix(model.camera))


def _measured(exact: Model, rng: np.random.Generator, closed: bool = True, spread: float = SPREAD) -> Model:
    """Return H as measured by batches with errors of their own, whose rows add up to 0 if no light is lost."""
    matrix = exact.matrix
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    counts = np.diff(matrix.indptr)
    batches = spread * BATCHES**0.5 * rng.normal(size=(BATCHES, matrix.nnz)) * matrix.data
    if closed:
        for batch in batches:
            batch -= (np.bincount(rows, batch) / counts)[rows]
    mean = batches.mean(axis=0)
    variance = np.square(batches - mean).mean(axis=0) / (BATCHES - 1)
    stored = sparse.csr_array((matrix.data + mean, matrix.indices, matrix.indptr), shape=matrix.shape)
    record = {"method": "transport"}
    return replace(exact, stored=stored, variance=variance, batches=(batches - mean).astype(np.float32), record=record)


def _method(model: Model, recorded: FloatArray, noise: FloatArray) -> DenseMethod:
    described = model.scene
    used = np.ones(recorded.size, dtype=np.bool_)
    task = EstimationTask(model, recorded, used, noise, described.prior, described.estimator, described.tiles)
    return DenseMethod(task, Execution())


def _operators(method: DenseMethod) -> PosteriorOperators:
    return not_none(method.operators())


def _attenuation(method: DenseMethod, noise: FloatArray, rng: np.random.Generator) -> Attenuation:
    operators, root = _operators(method), np.sqrt(noise)
    white = rng.normal(size=noise.size)
    return Attenuation.of(method, operators, [white], [operators.gain(root * white)], root)


@pytest.mark.parametrize("closed", [True, False])
def test_light_lost_beside_the_target_is_uncertain_too(closed: bool) -> None:
    """A bright flat wall shows nothing but the errors of the rows' sums: none where all light meets the target."""
    exact, wall = _exact(), np.full(361, 200.0)
    squares, stated = np.zeros(exact.measurements), np.zeros(exact.measurements)
    for seed in range(DRAWS):
        model = _measured(exact, np.random.default_rng(seed), closed)
        squares += np.square((model.matrix - exact.matrix) @ wall)
        stated += model.variance_from_model(wall)
    if closed:
        assert stated.max() < 1e-9
        return
    values = DRAWS * exact.measurements
    assert squares.sum() / stated.sum() == pytest.approx(1, abs=5 * (2 / values + 2 / values / (BATCHES - 1)) ** 0.5)


def test_the_attenuation_is_that_of_dense_matrices() -> None:
    """C D f by the definition of D, with the exact share 1 - (H A)_ii of every residual."""
    exact, rng = _exact(), np.random.default_rng(8)
    image = 127.5 + 60 * rng.normal(size=361)
    model = _measured(exact, rng)
    noise = NOISE + model.variance_from_model(image)
    method = _method(model, exact.matrix @ image, noise)
    h = model.matrix.toarray()
    posterior = np.linalg.inv(h.T @ (h / noise[:, None]) + np.eye(361) / model.scene.prior.variance)
    share = 1 - np.einsum("ij,jk,ik->i", h, posterior, h) / noise
    attenuation = replace(_attenuation(method, noise, rng), residual_share=share)
    lost: list[FloatArray] = []
    for half, errors in zip(attenuation.halves(image), model.error_halves, strict=True):
        dense = [error.toarray() for error in errors]
        total = sum((error.T @ (share / noise * (error @ image)) for error in dense), np.zeros(361))
        lost.append(posterior @ total)
        np.testing.assert_allclose(half, lost[-1], rtol=1e-6, atol=1e-8)
    assert attenuation.strength(image) == pytest.approx(image @ np.mean(lost, axis=0) / (image @ image), rel=1e-6)


def test_one_draw_shows_leverages_near_one() -> None:
    """Of a lens type that sees fewer measurements than pixels: the mean of 1 - (H A)_ii, which is far below 1."""
    exact, rng = _exact(THREE[:1]), np.random.default_rng(9)
    image = 127.5 + 60 * rng.normal(size=361)
    model = _measured(exact, rng)
    noise = NOISE + model.variance_from_model(image)
    method = _method(model, exact.matrix @ image, noise)
    h = model.matrix.toarray()
    inverse = np.linalg.inv(h @ h.T * model.scene.prior.variance + np.diag(noise))
    share = float(np.mean(noise * np.diagonal(inverse)))
    assert share < 0.05
    found = np.array([_attenuation(method, noise, rng).residual_share.mean() for _ in range(DRAWS)])
    scatter = (2 / noise.size) ** 0.5  # of the mean square of the draw
    assert np.square(found - share).mean() ** 0.5 < 0.1 * scatter


@pytest.mark.slow
def test_the_attenuation_is_the_mean_effect_of_errors_of_h() -> None:
    """The mean of A E f over draws of E, against C D f from the batches of each draw."""
    exact = _exact()
    image = 127.5 + 60 * np.random.default_rng(1).normal(size=361)
    effects: list[FloatArray] = []
    stated: list[float] = []
    for seed in range(4 * DRAWS):
        rng = np.random.default_rng([seed, 2])
        model = _measured(exact, rng)
        noise = NOISE + model.variance_from_model(image)
        method = _method(model, exact.matrix @ image, noise)
        effects.append(_operators(method).gain((model.matrix - exact.matrix) @ image))
        first, second = _attenuation(method, noise, rng).halves(image)
        stated.append(float(first @ second))
    products = np.array(effects) @ np.array(effects).T
    pairs = products[~np.eye(len(effects), dtype=np.bool_)]  # of independent draws: unbiased
    measured, error = float(pairs.mean()), float(pairs.std()) / (len(effects) / 2**0.5)
    assert measured > 4 * error  # there is something to predict
    assert np.mean(stated) == pytest.approx(measured, abs=3 * error + 0.2 * measured)  # first order in the variances


@pytest.mark.slow
def test_errors_of_h_fit_the_residual_as_they_attenuate_the_estimate() -> None:
    """The residual with errors of H, less that of the same errors by the gain of another H, as the batches show it."""
    exact = _exact()
    image = 127.5 + 60 * np.random.default_rng(1).normal(size=361)
    changes: list[float] = []
    stated: list[float] = []
    for seed in range(3 * DRAWS):
        rng = np.random.default_rng([seed, 4])
        pair = [_measured(exact, rng, spread=0.06) for _ in range(2)]
        noise = NOISE + pair[0].variance_from_model(image)
        methods = [_method(model, exact.matrix @ image, noise) for model in pair]
        for model, method, other, unrelated in zip(pair, methods, pair[::-1], methods[::-1], strict=True):
            residual = exact.matrix @ image - model.matrix @ method.image
            errors, operators = (exact.matrix - model.matrix) @ image, _operators(unrelated)
            apart = errors - other.matrix @ (operators.gain(errors) - operators.hidden(image - 127.5))
            changes.append(float(np.sum((residual**2 - apart**2) / noise)))
            attenuation = _attenuation(method, noise, rng)
            stated.append(float(attenuation.residual_change(method.task, attenuation.effect(image, 127.5)).sum()))
    measured, error = np.mean(changes), np.std(changes) / len(changes) ** 0.5
    assert measured < -8 * error  # there is something to predict
    assert np.mean(stated) == pytest.approx(measured, abs=3 * error + 0.2 * abs(measured))


def test_residuals_show_where_the_uncertainty_of_h_lies() -> None:
    rng = np.random.default_rng(7)
    rest = np.full(4000, NOISE)
    first, second = NOISE * np.exp(rng.normal(size=(2, rest.size)))
    for share in (0.0, 0.5, 1.0):
        variance = rest + (1 - share) * first + share * second
        assert likeliest_share(variance * rng.chisquare(1, rest.size), rest, first, second) == share


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.0, 0.3, 20.0])
def test_the_noise_of_an_estimate_is_not_taken_for_contrast(contrast: float) -> None:
    """The variance that errors of H add is that for the true image, which the estimate shows noisy."""
    exact = _exact()
    true, stated, plain = 0.0, 0.0, 0.0
    for seed in range(DRAWS):
        rng = np.random.default_rng([seed, 3])
        image = 127.5 + contrast * rng.normal(size=361)
        model = _measured(exact, rng, spread=5e-3)
        noise = NOISE + model.variance_from_model(image)
        recorded = exact.matrix @ image + NOISE**0.5 * rng.normal(size=noise.size)
        method = _method(model, recorded, noise)
        by_cause = {"noise": np.full(noise.size, NOISE), "calibration": noise - NOISE}
        contrasts = true_contrast(method, _operators(method), total_variance(by_cause), attenuated=True)
        true += float(model.variance_from_model(image).sum())
        stated += float(contrasts.calibration(method, by_cause).sum())
        plain += float(model.variance_from_model(method.image).sum())
    chance = 0.2 * plain if contrast < 1 else 0.0
    assert stated == pytest.approx(true, rel=0.1, abs=chance)
    if contrast < 1:
        assert plain > true + 4 * chance  # the noise of the estimate alone


def test_operators_of_tiles_are_those_of_the_dense_form() -> None:
    exact = _exact()
    rng = np.random.default_rng(5)
    method = _method(
        _measured(exact, rng), exact.matrix @ (127.5 + 60 * rng.normal(size=361)), np.full(exact.measurements, NOISE)
    )
    dense, iterative = _operators(method), TileMethod(method.task, Execution()).operators()
    image, values = 1e3 * rng.normal(size=361), 1e3 * rng.normal(size=exact.measurements)
    for name, argument in (("gain", values), ("posterior", image), ("hidden", image), ("weigh", values)):
        expected = getattr(dense, name)(argument)
        np.testing.assert_allclose(getattr(iterative, name)(argument), expected, atol=0.02 * np.abs(expected).max())


def test_bands_of_frequency_add_up_to_the_image() -> None:
    waves = Waves((23, 31))
    image = np.random.default_rng(6).normal(size=23 * 31)
    bands = sum((waves.band(image, number) for number in range(waves.counts.size)), np.zeros(waves.shape))
    np.testing.assert_allclose(bands.ravel(), image - image.mean(), atol=1e-12)
    assert waves.power(image) @ waves.counts == pytest.approx(float(np.square(image - image.mean()).sum()))


def test_a_hidden_end_of_a_spectrum_follows_its_power_law() -> None:
    frequencies = np.geomspace(0.01, 1, 9)
    spectrum = frequencies**-2.5
    known = frequencies < 0.2
    np.testing.assert_allclose(continued(frequencies, np.where(known, spectrum, -1.0), known), spectrum, rtol=1e-9)
    assert not continued(frequencies, spectrum, np.zeros(9, dtype=np.bool_)).any()


def test_a_target_of_one_pixel_has_no_waves() -> None:
    described = scene((1, 1), ((1, [1, 1], [1, 1]),), noise={"variance": NOISE})
    model = ideal_model(described, derive(described))
    noise = np.full(1, NOISE)
    method = _method(replace(model, stored=ideal_matrix(model.camera)), np.full(1, 100.0), noise)
    contrast = true_contrast(method, _operators(method), noise, attenuated=False)
    assert contrast.image == pytest.approx(method.image)
