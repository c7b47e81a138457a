"""Priors: spectra by their definition, as densities, by limits and from random draws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.reconstruct.prior import (
    Prior,
    coloured,
    exponential,
    exponential_spectrum,
    independent,
    prior_of,
    spectrum_of,
)
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.tables.estimation import PriorTable

from ..examples import covariance_of

SHAPE = (5, 7)


def waves(shape: tuple[int, int]) -> FloatArray:
    """Cosine waves of an image that is reflected half a pixel beyond its edges, as columns: (N, N)."""
    axes = [np.cos(np.pi * np.outer(np.arange(size) + 0.5, np.arange(size)) / size) for size in shape]
    joined = np.kron(*axes)
    return joined / np.linalg.norm(joined, axis=0)


def falling(shape: tuple[int, int], length: float) -> FloatArray:
    """exp(-distance / length) between all pixels: (N, N)."""
    rows, columns = np.indices(shape).reshape(2, -1)
    return np.exp(-np.hypot(np.subtract.outer(rows, rows), np.subtract.outer(columns, columns)) / length)


@pytest.mark.parametrize("shape", [SHAPE, (1, 6), (12, 11)])
def test_each_wave_has_the_variance_that_an_exponential_covariance_gives_it(shape: tuple[int, int]) -> None:
    basis = waves(shape)
    expected = np.diagonal(basis.T @ falling(shape, 3.0) @ basis)
    assert basis.T @ covariance_of(exponential(0.0, 4.0, shape, 3.0)) @ basis == pytest.approx(np.diag(4 * expected))


def test_far_from_the_edges_the_covariance_is_exponential() -> None:
    """The edges take part of the variance from there, in proportion to length / side."""

    def worst(side: int) -> float:
        prior, middle = exponential(0.0, 1.0, (side, side), 2.0), side // 2 * (side + 1)
        around = covariance_of(prior)[middle].reshape(side, side)[side // 2 :, side // 2 :][:5, :5]
        return float(np.abs(around - falling((5, 5), 2.0)[0].reshape(5, 5)).max())

    assert worst(20) < 2 * 2.0 / 20
    assert worst(40) < 0.6 * worst(20)


def test_the_spectrum_is_the_density_with_its_aliases() -> None:
    """(2 pi / length) sum of (1 / length^2 + |w + 2 pi m|^2)^(-3/2), the sum beyond 20 periods by its integral.

    The width of a wave in frequency, pi / 240, is small beside 1 / length.
    """
    side, length, most = 240, 1.5, 20
    index = [6, 80, 239]
    periods = 2 * np.pi * np.arange(-most, most + 1)
    squares = np.square(np.pi * np.array(index)[:, None] / side + periods)
    sums = [[float(np.sum((length**-2 + down[:, None] + across) ** -1.5)) for across in squares] for down in squares]
    corner = (2 * most + 1) * np.pi
    beyond = 4 * length * (np.pi / 2 - np.arctan(corner**2 * length / np.hypot(1 / length, 2**0.5 * corner)))
    expected = 2 * np.pi / length * (np.array(sums) + beyond / (2 * np.pi) ** 2)
    assert exponential_spectrum((side, side), length)[np.ix_(index, index)] == pytest.approx(expected, rel=0.04)


@given(
    st.tuples(st.integers(1, 60), st.integers(1, 60)),
    st.floats(1e-3, 1e9),
    st.sampled_from([{"kind": "exponential", "correlation_length": "1 mm"}, {"kind": "power", "exponent": 8.0}]),
)
def test_spectra_are_positive_and_pixels_have_their_variance_on_average(
    shape: tuple[int, int], length: float, table: dict[str, Any]
) -> None:
    prior = PriorTable.model_validate(table | {"variance": 7.0})
    spectrum = np.asarray(spectrum_of(prior, shape, 1 / length))
    assert spectrum.min() > 0
    assert spectrum.mean() == pytest.approx(7.0)
    assert np.isfinite(1 / spectrum).all()


def test_limits_of_the_correlation_length() -> None:
    """Independent pixels, or pixels that are all alike, but for differences that fall as 1 / length."""
    assert exponential_spectrum(SHAPE, 1e-3) == pytest.approx(np.ones(SHAPE))
    long, longer = exponential_spectrum(SHAPE, 1e6), exponential_spectrum(SHAPE, 1e7)
    assert longer[0, 0] == pytest.approx(longer.size)
    assert long.ravel()[1:] == pytest.approx(10 * longer.ravel()[1:], rel=1e-5)


def test_images_are_drawn_by_the_root_of_the_covariance() -> None:
    spectrum = exponential_spectrum(SHAPE, 2.0)
    images = coloured(spectrum, np.eye(35).reshape(35, *SHAPE)).reshape(35, 35)
    np.testing.assert_allclose(images.T, exponential(0.0, 1.0, SHAPE, 2.0).root, atol=1e-14)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0, 4.0])
def test_the_power_law_prior_has_its_spectrum(exponent: float) -> None:
    table = PriorTable(kind="power", variance=6.0, exponent=exponent)
    spectrum, basis = np.asarray(spectrum_of(table, (6, 8), 1.0)), waves((6, 8))
    assert basis.T @ covariance_of(prior_of(table, (6, 8), 1.0)) @ basis == pytest.approx(np.diag(spectrum.ravel()))
    assert spectrum[3, 4] / spectrum[1, 0] == pytest.approx((np.hypot(3 / 6, 4 / 8) / (1 / 6)) ** -exponent)
    assert spectrum[0, 0] == spectrum[0, 1] == spectrum.max()
    if exponent == 0:
        assert spectrum == pytest.approx(np.full((6, 8), 6.0))


def test_a_correlation_length_on_the_target_is_converted_to_pixels() -> None:
    table = PriorTable.model_validate({"kind": "exponential", "correlation_length": "6 mm", "variance": 1.0})
    assert covariance_of(prior_of(table, SHAPE, 2.0)) == pytest.approx(covariance_of(exponential(0, 1.0, SHAPE, 3.0)))


@pytest.mark.parametrize("prior", [independent(0.0, 2.0, 35), exponential(0.0, 2.0, SHAPE, 2.0)])
def test_the_root_and_its_transpose_pass_the_dot_test(prior: Prior) -> None:
    rng = np.random.default_rng(1)
    u, f = rng.normal(size=prior.dimension), rng.normal(size=35)
    assert f @ prior.apply_root(u) == pytest.approx(prior.apply_root_transposed(f) @ u)
    assert prior.variance.mean() == pytest.approx(2.0)


def test_a_fitted_prior_needs_a_stack() -> None:
    with pytest.raises(InputError, match="takes a recorded stack"):
        prior_of(PriorTable(kind="fit"), SHAPE, 1.0)
