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

from ..examples import GALLERY, not_none, slow

PRIOR = PriorTable()


def predicted(name: str, lenses: tuple[str, ...], *changes: str) -> Prediction:
    return predict_scene(read(GALLERY / f"{name}.toml", changes, lenses), rays=False)


TILE19 = [("tile19", lenses) for lenses in ((), ("I", "II"), ("I",), ("I", "I"))]


@pytest.mark.parametrize(("name", "lenses"), [*TILE19, *(slow(name, ()) for name in ("tile35", "tile41"))])
@pytest.mark.parametrize(("actual", "expected"), [(1e-6, 1e-6), (1.0, 1.0), (1e-4, 1e-2), (1e-2, 1e-4)])
def test_prediction_by_singular_values(name: str, lenses: tuple[str, ...], actual: float, expected: float) -> None:
    """For independent pixels: the mean of (e^2 + a s^2 P0) P0 / (e + s^2 P0)^2 over all singular values s."""
    matrix = ideal_matrix(derive(read(GALLERY / f"{name}.toml", (), lenses))).toarray()
    values, p0 = np.linalg.svd(matrix, compute_uv=False), PRIOR.variance
    squares = np.zeros(matrix.shape[1])
    squares[: values.size] = np.square(values)
    parts = (expected**2 + actual * squares * p0) * p0 / (expected + squares * p0) ** 2
    prediction = predicted(name, lenses, f"noise.variance={actual}", f"estimator.noise_variance={expected}")
    assert prediction.mse == pytest.approx(np.mean(parts), rel=1e-6)
    rank = int((values > 1e-9).sum())
    assert (prediction.rank, prediction.null_space) == (rank, matrix.shape[1] - rank)
    assert prediction.condition == pytest.approx(values[0] / values[rank - 1], rel=1e-6)


def test_reference_values_of_extended_precision() -> None:
    """By 300 bits, to all the digits that they were given with."""
    given = "noise.variance=1e-2", "estimator.noise_variance=1e-4"
    prediction = predicted("tile19", (), *given)
    assert (prediction.mse, prediction.trimmed_mse) == pytest.approx((2.79766, 1.85623), rel=5e-6)
    assert predicted("tile19", (), "noise.variance=1e-6").mse == pytest.approx(2.79776586e-4, rel=1e-5)


def test_the_noise_of_a_sensor_is_that_of_its_picture() -> None:
    """Against the dense solution for the shot noise, read noise and rounding of the light that the picture sends."""
    sensor = ("noise=", 'sensor.illuminance="500 lux"', 'sensor.exposure="0.5 ms"', "camera.wavelength=none")
    apertures = tuple(f'camera.lens.{name}.aperture="0.1 mm"' for name in ("I", "II", "III"))
    scene = read(GALLERY / "tile19.toml", (*apertures, *sensor))
    setup = Setup.from_scene(scene)
    dense, response = ideal_matrix(setup.camera).toarray(), electrons(scene, setup.camera)
    light = dense @ setup.image.ravel()
    noise = expected_recording(not_none(scene.sensor), setup.camera, response, light).noise_variance(light)
    exact = np.linalg.inv(dense.T @ (dense / noise[:, None]) + np.eye(361) / PRIOR.variance)
    prediction = predict_scene(scene, rays=False)
    assert prediction.mse == pytest.approx(float(np.trace(exact)) / 361, rel=0.02)
    assert sum(not_none(prediction.budget).values()) == pytest.approx(prediction.mse, rel=1e-9)


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
    assert 0.9 < not_none(error.ssim) < 1
    same = measure_error(truth.ravel(), truth.ravel(), (20, 20))
    assert (same.mse, same.psnr, same.ssim) == (0, None, pytest.approx(1))
    assert measure_error(np.zeros(4), np.ones(4), (2, 2)).trimmed_mse is None
    assert measure_error(np.zeros(4), np.ones(4), (2, 2)).ssim is None


def test_trimming_takes_the_border_off() -> None:
    image = np.ones((7, 9))
    image[2:-2, 2:-2] = 5
    assert trimmed_mean(image.ravel(), (7, 9)) == 5
