"""Maps of the variance of every pixel against dense inverses and against exact solutions for single pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft, linalg

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.frame.preconditioner import preconditioner_for
from ommatid.reconstruct.frame.selected_inverse import frame_variances, inverse_diagonal
from ommatid.reconstruct.frame.variance_map import posterior_map, sliding_maps, small_map, small_shape
from ommatid.reconstruct.prior import spectrum_of
from ommatid.scenes.optics.boxes import BoxFootprints
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses
from ..frames import FITTED, P0, blurred, frame_camera, precision, wide

STATED = 1e-3


@pytest.mark.parametrize("shape", [(119, 119), (128, 101)])
@pytest.mark.parametrize("noise", [1e-6, 1e-2, 10.0])
def test_the_map_is_right_to_what_is_stated(shape: tuple[int, int], noise: float) -> None:
    """Corners, edges, a little inside them, and the middle, with every pixel seen by all types and without."""
    one = frame_camera(shape)
    found = posterior_map(preconditioner_for(one, (1 / noise,) * 3, 1 / P0))
    frame = FrameSystem(one, BoxFootprints(one), np.full(one.measurements, 1 / noise), 1 / P0)
    rows, columns = shape
    for row, column in (
        *((0, 0), (0, 50), (1, 2), (rows - 1, 5), (rows - 2, columns - 3), (4, 60), (rows // 2, columns - 1)),
        *((17, 40), (19, 19), (20, 55), (22, 24), (rows // 2, columns // 2), (rows // 3, 19), (rows - 21, 33)),
    ):
        unit = np.zeros(one.unknowns)
        unit[row * columns + column] = 1.0
        exact = frame.solve(unit, 1e-6).image[row * columns + column]
        assert found[row, column] == pytest.approx(exact, rel=STATED), (row, column)


def test_the_interior_is_the_known_noise_gain() -> None:
    """95.8 v for magnifications 1/3, 1/4 and 1/5, as computed independently in exact arithmetic."""
    one = frame_camera((119, 119))
    found = posterior_map(preconditioner_for(one, (1e6,) * 3, 1 / P0))
    assert found[60, 60] / 1e-6 == pytest.approx(95.8, abs=0.05)


@pytest.mark.parametrize("actual", [(0.3, 0.3, 0.3), (1e-4, 1e-3, 1e-2), (0.01, 0.01, 0.01)])
def test_noise_that_is_not_what_was_expected(actual: tuple[float, float, float]) -> None:
    """Eq. 5 from a derivative, against Eq. 5 from dense matrices, on a frame so small that strips hold all of it."""
    one = frame_camera((38, 35))
    found = sliding_maps(preconditioner_for(one, (100.0,) * 3, 1 / P0), actual, posterior_map)
    matrix = ideal_matrix(one)
    covariance = linalg.inv(precision(matrix, np.full(one.measurements, 100.0), 1 / P0))
    noise = np.concatenate([np.full(kind.measurements, value) for kind, value in zip(one.types, actual, strict=True)])
    middle = precision(matrix, 1e4 * noise, 0.0)
    np.testing.assert_allclose(found.posterior.ravel(), np.diagonal(covariance), rtol=1e-9)
    np.testing.assert_allclose(found.missing.ravel(), np.square(covariance).sum(axis=1) / P0, rtol=2e-4)
    whole = np.square(covariance).sum(axis=1) / P0 + np.diagonal(covariance @ middle @ covariance)
    np.testing.assert_allclose((found.missing + found.noisy).ravel(), whole, rtol=2e-4)


def test_pixels_that_go_together() -> None:
    """The map of a small frame, repeated, against all of C of a frame half as large again."""
    shape = (66, 66)
    described = PriorTable(kind="exponential", variance=2000.0, correlation_length="5 mm")  # type: ignore[arg-type]
    one = frame_camera(shape)
    near = preconditioner_for(one, (1.0,) * 3, 1 / np.asarray(spectrum_of(described, shape, 1.0)))
    found = small_map(near, 1 / np.asarray(spectrum_of(described, small_shape(shape), 1.0)))
    waves = np.kron(*(np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape))
    known = waves.T @ (np.asarray(near.prior).ravel()[:, None] * waves)
    dense = precision(ideal_matrix(one), np.ones(one.measurements), 0.0) + known
    np.testing.assert_allclose(found.ravel(), np.diagonal(linalg.inv(dense)), rtol=STATED)


def test_the_diagonal_of_an_inverse_by_blocks() -> None:
    rng = np.random.default_rng(0)
    root = np.tril(np.triu(rng.normal(size=(30, 30)), -5)) + 4 * np.eye(30)
    matrix = root @ root.T  # joins no more than 5 neighbours
    places = [slice(first, first + 6) for first in range(0, 30, 6)]
    found = inverse_diagonal(5, lambda one, other: matrix[places[one], places[other]])
    np.testing.assert_allclose(found, np.diagonal(linalg.inv(matrix)), rtol=1e-10)


@pytest.mark.parametrize("lenses", [FITTED, (("1/4", [2, 3], "fit"), ("1/3", [3, 3], "fit"))], ids=["fitted", "other"])
def test_any_h_and_any_noise(lenses: Lenses) -> None:
    """H with errors of its own, and noise over a decade, against the dense inverse."""
    model, _ = blurred(wide((62, 57), lenses), 0.004)
    weights = 10 ** np.random.default_rng(1).uniform(1, 2, model.measurements)
    dense = precision(model.matrix, weights, 1 / P0)
    sparse_one = model.matrix.T @ model.matrix.multiply(weights[:, None])
    identity = type(model.matrix)(np.eye(model.unknowns)) / P0
    found = frame_variances(type(model.matrix)(sparse_one + identity), (62, 57), model.reach - 1, halo=57)
    np.testing.assert_allclose(found.ravel(), np.diagonal(linalg.inv(dense)), rtol=1e-8)
    if lenses == FITTED:
        near = frame_variances(type(model.matrix)(sparse_one + identity), (62, 57), model.reach - 1, halo=25)
        np.testing.assert_allclose(near, found, rtol=STATED)
