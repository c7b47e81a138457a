"""Conjugate gradients against dense solutions, and their bound against the error that is really left."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft, linalg

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.prior import lag_distances, spectrum_of
from ommatid.runtime.errors import InputError
from ommatid.scenes.optics.boxes import BoxFootprints
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses
from ..frames import FITTED, P0, blurred, frame_camera, precision, wide

Vector = NDArray[np.float64]
TWO: Lenses = FITTED[:2]


def worst(found: Vector, right: Vector, covariance: Vector) -> float:
    """Largest error of a pixel in its posterior standard deviations."""
    return float(np.max(np.abs(found - right) / np.sqrt(np.diagonal(covariance))))


@pytest.mark.parametrize("shape", [(59, 59), (64, 47)])
@pytest.mark.parametrize("noise", [1e-6, 1e-2, 10.0])
@pytest.mark.parametrize("lenses", [FITTED, TWO], ids=["three", "two"])
def test_every_pixel_is_as_right_as_the_bound_says(shape: tuple[int, int], noise: float, lenses: Lenses) -> None:
    """With a null space and without, with pixels that some types do not see and without."""
    one = frame_camera(shape, lenses)
    weights = np.full(one.measurements, 1 / noise)
    frame = FrameSystem(one, BoxFootprints(one), weights, 1 / P0)
    matrix, rng = ideal_matrix(one), np.random.default_rng(3)
    dense = precision(matrix, weights, 1 / P0)
    covariance = linalg.inv(dense)
    truth = rng.normal(0, P0**0.5, one.unknowns)
    right = frame.collected(matrix @ truth + rng.normal(0, noise**0.5, one.measurements))
    expected = linalg.solve(dense, right, assume_a="pos")
    for accuracy in (0.3, 0.01):
        found = frame.solve(right, accuracy)
        error = worst(found.image, expected, covariance)
        rounding = 1e-4 if noise < 1e-5 else 0.0  # of the dense solution
        assert error <= found.bound + rounding
        assert found.bound <= accuracy


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_holds_where_neither_h_nor_noise_is_even(seed: int) -> None:
    """H with errors of its own, noise over two decades, pixels that are dead: many steps, and the bound holds."""
    described = wide((60, 55))
    model, _ = blurred(described, 0.005, seed)
    rng = np.random.default_rng(seed)
    weights = 10 ** rng.uniform(0, 2, model.measurements)
    weights[rng.choice(model.measurements, 300, replace=False)] = 0.0
    frame = FrameSystem(model.camera, model, weights, 1 / P0)
    dense = precision(model.matrix, weights, 1 / P0)
    right = frame.collected(model.forward(rng.normal(0, P0**0.5, model.unknowns)))
    found = frame.solve(right)
    assert found.steps > 10
    assert worst(found.image, linalg.solve(dense, right, assume_a="pos"), linalg.inv(dense)) <= found.bound <= 0.01


@pytest.mark.parametrize(
    "described",
    [
        PriorTable(kind="exponential", variance=2000.0, correlation_length="8 mm"),  # type: ignore[arg-type]
        PriorTable(kind="power", variance=2000.0),
    ],
    ids=["exponential", "power"],
)
def test_a_prior_that_is_diagonal_under_the_cosine_transform(described: PriorTable) -> None:
    shape = (48, 53)
    one = frame_camera(shape)
    spectrum = np.asarray(spectrum_of(described, shape, 1.0))
    frame = FrameSystem(one, BoxFootprints(one), np.full(one.measurements, 100.0), 1 / spectrum)
    waves = np.kron(*(np.asarray(fft.dct(np.eye(size), 2, axis=0, norm="ortho")) for size in shape))
    known = waves.T @ ((1 / spectrum.ravel())[:, None] * waves)
    dense = precision(ideal_matrix(one), frame.weights, 0.0) + known
    rng = np.random.default_rng(0)
    image = rng.normal(size=one.unknowns)
    np.testing.assert_allclose(frame.expected(image), known @ image, rtol=1e-9, atol=1e-12 * np.abs(known).max())
    right = frame.collected(frame.observation.forward(rng.normal(0, 40, one.unknowns)))
    found = frame.solve(right)
    assert worst(found.image, linalg.solve(dense, right, assume_a="pos"), linalg.inv(dense)) <= found.bound <= 0.01


def test_inside_the_frame_that_prior_is_the_stationary_one() -> None:
    shape = (48, 40)
    described = PriorTable(kind="exponential", variance=900.0, correlation_length="3 mm")  # type: ignore[arg-type]
    spectrum = np.asarray(spectrum_of(described, shape, 1.0))
    unit = np.zeros(shape)
    unit[24, 20] = 1.0
    row = fft.idctn(spectrum * fft.dctn(unit, 2, norm="ortho"), 2, norm="ortho")
    lags = 900 * np.exp(-lag_distances(shape) / 3)
    for down, across in ((0, 0), (3, 0), (0, -5), (7, 4)):
        assert row[24 + down, 20 + across] == pytest.approx(lags[abs(down), abs(across)], abs=0.02)


def test_the_bound_asked_for_is_reached_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.reconstruct.frame.conjugate_gradients.MOST_STEPS", 3)
    one = frame_camera((60, 55), TWO)
    frame = FrameSystem(one, BoxFootprints(one), np.full(one.measurements, 1e4), 1 / P0)
    with pytest.raises(InputError, match=r"after 3 steps, asked were 0\.01; take estimator\.method = 'tiles'"):
        frame.solve(np.random.default_rng(0).normal(size=one.unknowns))


def test_nothing_recorded_is_nothing_found() -> None:
    one = frame_camera((40, 40))
    found = FrameSystem(one, BoxFootprints(one), np.ones(one.measurements), 1.0).solve(np.zeros(one.unknowns))
    assert (found.steps, found.bound) == (0, 0.0)
    assert not found.image.any()
