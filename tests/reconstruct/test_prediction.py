"""Measured errors, and predictions against the paper's numbers by other methods."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.analysis.predict import predict_scene
from ommatid.reconstruct.measured_error import measure_error, trimmed_mean
from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.recording import expected_recording
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.simulate.ideal import ideal_matrix

from ..examples import GALLERY

PRIOR = PriorTable()


def predicted(name: str, lenses: tuple[str, ...], *changes: str) -> Prediction:
    return predict_scene(read(GALLERY / f"{name}.toml", changes, lenses), rays=False)


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
    prediction = predicted(name, lenses, "noise.variance=1e-6")
    assert prediction.mse == pytest.approx(reference, rel=1e-5)
    assert (prediction.rank, prediction.null_space) == (rank, prediction.unknowns - rank)


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
    prediction = predicted(name, lenses, f"noise.variance={actual}", f"estimator.noise_variance={expected}")
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
    prediction = predicted("tile19", lenses, f"noise.variance={noise}")
    assert prediction.mse == pytest.approx(by_values, rel=1e-6)
    assert prediction.rank == np.linalg.matrix_rank(matrix.toarray(), tol=1e-9)
    seen = values[: prediction.rank]
    assert prediction.condition == pytest.approx(seen[0] / seen[-1], rel=1e-6)


def test_the_noise_of_a_sensor_is_that_of_its_picture() -> None:
    """Against the dense solution for the shot noise, read noise and rounding of the light that the picture sends."""
    sensor = ("noise=", 'sensor.illuminance="500 lux"', 'sensor.exposure="0.5 ms"', "camera.wavelength=none")
    apertures = tuple(f'camera.lens.{name}.aperture="0.1 mm"' for name in ("I", "II", "III"))
    scene = read(GALLERY / "tile19.toml", (*apertures, *sensor))
    setup = Setup.from_scene(scene)
    dense, response = ideal_matrix(setup.camera).toarray(), electrons(scene, setup.camera)
    assert scene.sensor is not None
    light = dense @ setup.image.ravel()
    noise = expected_recording(scene.sensor, setup.camera, response, light).noise_variance(light)
    exact = np.linalg.inv(dense.T @ (dense / noise[:, None]) + np.eye(361) / PRIOR.variance)
    prediction = predict_scene(scene, rays=False)
    assert prediction.mse == pytest.approx(float(np.trace(exact)) / 361, rel=0.02)
    assert prediction.budget is not None
    assert sum(prediction.budget.values()) == pytest.approx(prediction.mse, rel=1e-9)


def test_an_estimator_that_expects_no_noise_is_refused_as_its_run_is() -> None:
    with pytest.raises(InputError, match="measurements without noise contradict one another"):
        predicted("tile19", (), "noise.variance=2", "estimator.noise_variance=0")


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
