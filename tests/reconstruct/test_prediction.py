"""Measured errors, and predictions against the paper's numbers by other methods."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.reconstruct.measured_error import measure_error, trimmed_mean
from ommatid.reconstruct.prediction import predict
from ommatid.reconstruct.prior import independent
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.scenes.tables.estimation import EstimatorTable, PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import GALLERY

PRIOR = PriorTable()


@pytest.mark.parametrize(
    ("name", "lenses", "reference", "rank"),
    [
        ("tile19", (), 2.79776586e-4, 361),
        ("tile19", ("I", "I"), 2057.42393, 225),
        ("tile19", ("I", "II"), 484.100274, 329),
        pytest.param("tile35", (), 1.54401e-4, 1225, marks=pytest.mark.slow),
        pytest.param("tile35", ("I", "II"), 89.16378, 1205, marks=pytest.mark.slow),
        pytest.param("tile41", (), 1.24737e-3, 1681, marks=pytest.mark.slow),
    ],
)
def test_reference_values_of_extended_precision(
    name: str, lenses: tuple[str, ...], reference: float, rank: int
) -> None:
    """Computed with 300 bits; expected and actual noise variance 1e-6."""
    camera = derive(read(GALLERY / f"{name}.toml", (), lenses))
    matrix = ideal_matrix(camera)
    shape = camera.shape
    prediction = predict(
        matrix, independent(PRIOR.mean, PRIOR.variance, camera.unknowns), 1e-6, EstimatorTable(), shape
    )
    assert prediction.mse == pytest.approx(reference, rel=1e-5)
    assert (prediction.rank, prediction.null_space) == (rank, camera.unknowns - rank)


@pytest.mark.parametrize(
    ("name", "lenses", "actual", "expected", "reference", "digits"),
    [
        ("tile19", (), 1e-4, 1e-2, 0.0330911224, 1e-8),
        ("tile19", ("I", "II"), 1e-4, 1e-2, 484.191545, 1e-8),
        ("tile19", ("I", "II"), 1e-2, 1e-4, 489.606, 2.5e-5),
        ("tile19", (), 1e-2, 1e-4, 2.79766, 2.5e-5),
        pytest.param("tile35", (), 1.0, 1.0, 139.233, 2.5e-5, marks=pytest.mark.slow),
        pytest.param("tile35", ("I", "II"), 1.0, 1.0, 397.08, 2.5e-5, marks=pytest.mark.slow),
    ],
)
def test_reference_values_where_the_expectation_is_wrong(
    name: str, lenses: tuple[str, ...], actual: float, expected: float, reference: float, digits: float
) -> None:
    """To all the digits that they were given with."""
    camera = derive(read(GALLERY / f"{name}.toml", (), lenses))
    prior = independent(PRIOR.mean, PRIOR.variance, camera.unknowns)
    prediction = predict(ideal_matrix(camera), prior, actual, EstimatorTable(noise_variance=expected), camera.shape)
    assert prediction.mse == pytest.approx(reference, rel=digits)
    if reference == 2.79766:
        assert prediction.trimmed_mse == pytest.approx(1.85623, rel=5e-6)


@pytest.mark.parametrize("lenses", [(), ("I", "II"), ("I",)])
@pytest.mark.parametrize("noise", [1e-6, 1.0])
def test_prediction_by_eigenvalues(lenses: tuple[str, ...], noise: float) -> None:
    """With a white prior the expected error is the mean over H's singular values s of v P0 / (v + s^2 P0)."""
    camera = derive(read(GALLERY / "tile19.toml", (), lenses))
    matrix = ideal_matrix(camera)
    singular = np.zeros(361)
    values = np.linalg.svd(matrix.toarray(), compute_uv=False)
    singular[: values.size] = values
    by_values = np.mean(noise * PRIOR.variance / (noise + singular**2 * PRIOR.variance))
    prediction = predict(matrix, independent(PRIOR.mean, PRIOR.variance, 361), noise, EstimatorTable(), (19, 19))
    assert prediction.mse == pytest.approx(by_values, rel=1e-6)
    assert prediction.rank == np.linalg.matrix_rank(matrix.toarray(), tol=1e-9)
    seen = values[: prediction.rank]
    assert prediction.condition == pytest.approx(seen[0] / seen[-1], rel=1e-6)


def test_measures_of_error() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 255, (20, 20))
    noisy = truth + rng.normal(0, 2, truth.shape)
    error = measure_error(noisy.ravel(), truth.ravel(), (20, 20))
    assert error.mse == pytest.approx(np.mean((noisy - truth) ** 2))
    assert error.psnr == pytest.approx(10 * np.log10(255**2 / error.mse))
    assert error.ssim is not None
    assert 0.9 < error.ssim < 1
    same = measure_error(truth.ravel(), truth.ravel(), (20, 20))
    assert (same.mse, same.psnr, same.ssim) == (0, None, pytest.approx(1))
    assert measure_error(np.zeros(4), np.ones(4), (2, 2)).trimmed_mse is None
    assert measure_error(np.zeros(4), np.ones(4), (2, 2)).ssim is None


def test_trimming_takes_the_border_off() -> None:
    image = np.ones((7, 9))
    image[2:-2, 2:-2] = 5
    assert trimmed_mean(image.ravel(), (7, 9)) == 5
