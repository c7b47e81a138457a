"""Priors: covariances by symmetry, by limits and from random draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ommatid.reconstruct.prior import Prior, exponential, independent, prior_of
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import parse
from ommatid.scenes.tables.estimation import PriorTable

from ..examples import scene

SHAPE = (5, 7)


def covariance(prior: Prior) -> FloatArray:
    return np.diag(prior.root**2) if prior.independent else prior.root @ prior.root.T


def test_independent_pixels() -> None:
    prior = independent(100.0, 9.0, 35)
    assert covariance(prior) == pytest.approx(9 * np.eye(35))
    assert prior.dimension == 35


def test_the_exponential_covariance_falls_with_the_distance_between_pixels() -> None:
    matrix = covariance(exponential(0.0, 4.0, SHAPE, 3.0)).reshape(*SHAPE, *SHAPE)
    for (r, c), (i, j) in [((0, 0), (0, 0)), ((0, 0), (0, 1)), ((4, 1), (1, 5)), ((4, 6), (0, 0))]:
        distance = ((r - i) ** 2 + (c - j) ** 2) ** 0.5
        assert matrix[r, c, i, j] == pytest.approx(4 * np.exp(-distance / 3))


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0, 4.0])
def test_the_power_law_prior_is_stationary_and_isotropic_and_has_its_variance(exponent: float) -> None:
    prior = prior_of(PriorTable(kind="power", variance=6.0, exponent=exponent), (6, 6), 1.0)
    matrix = covariance(prior).reshape(6, 6, 6, 6)
    assert np.einsum("ijij->ij", matrix) == pytest.approx(np.full((6, 6), 6.0))
    assert matrix[0, 0, 0, 2] == pytest.approx(matrix[3, 1, 3, 3])
    assert matrix[0, 0, 0, 2] == pytest.approx(matrix[0, 0, 2, 0])
    if exponent == 0:
        assert matrix.reshape(36, 36) == pytest.approx(6 * np.eye(36), abs=1e-12)
    else:
        assert matrix[0, 0, 0, 1] > matrix[0, 0, 0, 2] > matrix[0, 0, 0, 4]


def test_images_drawn_from_the_power_law_prior_have_its_spectrum() -> None:
    """The slope over one octave is -2, within 0.04 by leakage of the window and 4 standard errors of 0.03."""
    side, draws = 32, 300
    prior = prior_of(PriorTable(kind="power", variance=1.0, exponent=2.0, mean=0.0), (side, side), 1.0)
    rng = np.random.default_rng(0)
    images = prior.apply_root(rng.normal(size=(side**2, draws))).T.reshape(draws, side, side)
    window = np.outer(np.hanning(side), np.hanning(side))
    power = np.mean(np.abs(np.fft.fft2(images * window)) ** 2, axis=0)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    low, high = ((frequency > f / 1.1) & (frequency < f * 1.1) for f in (0.15, 0.3))
    slope = np.log(power[high].mean() / power[low].mean()) / np.log(frequency[high].mean() / frequency[low].mean())
    assert slope == pytest.approx(-2.0, abs=0.16)


def test_a_correlation_length_on_the_target_is_converted_to_pixels() -> None:
    table = PriorTable.model_validate({"kind": "exponential", "correlation_length": "6 mm", "variance": 1.0})
    assert covariance(prior_of(table, SHAPE, 2.0)) == pytest.approx(covariance(exponential(0, 1.0, SHAPE, 3.0)))


@pytest.mark.parametrize("prior", [independent(0.0, 2.0, 35), exponential(0.0, 2.0, SHAPE, 2.0)])
def test_the_root_and_its_transpose_pass_the_dot_test(prior: Prior) -> None:
    rng = np.random.default_rng(1)
    u, f = rng.normal(size=prior.dimension), rng.normal(size=35)
    assert f @ prior.apply_root(u) == pytest.approx(prior.apply_root_transposed(f) @ u)
    assert prior.variance == pytest.approx(np.full(35, 2.0))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"kind": "exponential"}, "needs a correlation_length"),
        ({"correlation_length": "1 mm"}, "belongs to kind"),
        ({"kind": "exponential", "correlation_length": 3.0}, "bare number"),
        ({"kind": "exponential", "correlation_length": "1 mm", "exponent": 2.0}, "exponent belongs"),
        ({"variance": 0.0}, "greater than 0"),
        ({"kind": "gaussian"}, "'independent', 'exponential', 'power' or 'fit'"),
    ],
)
def test_invalid_prior_tables_are_refused(table: dict[str, object], message: str) -> None:
    data = scene().plain() | {"prior": table}
    with pytest.raises(InputError, match=message):
        parse(data, Path("a.toml"))


def test_a_fitted_prior_needs_a_stack() -> None:
    with pytest.raises(InputError, match="takes a recorded stack"):
        prior_of(PriorTable(kind="fit"), SHAPE, 1.0)
