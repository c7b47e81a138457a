"""The predicted cost of a tolerance: against cameras and images drawn at random, limits, and the command."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ommatid.reconstruct.misalignment.moments import (
    misaligned_matrix,
    misaligned_moments,
    mismatch_variance,
    tolerances,
)
from ommatid.reconstruct.prior import independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import GALLERY, form_of, misaligned_camera
from ..runs import document


def cost_of(camera: Camera, variance: float = 1e-2) -> float:
    prior, used = independent(127.5, 5461.25, camera.unknowns), np.ones(camera.measurements, dtype=np.bool_)
    form = form_of(Problem(ideal_matrix(camera), prior, np.full(camera.measurements, variance)))
    moments = misaligned_moments(camera, prior)
    return float(mismatch_variance(form, used, moments, camera.slices(), prior).mean())


def mean_over(camera: Camera, tables: FloatArray, variance: float = 1e-2) -> tuple[float, float]:
    """Mean over misalignments of what each adds to the expected squared error, and its standard error over groups.

    tables : (groups, cameras, sub-imagers, 6);  with H' a camera's matrix, of P0 the share (I - A H') remains, and
    the prior's mean is off by A (H - H') f0
    """
    prior, designed = independent(127.5, 5461.25, camera.unknowns), ideal_matrix(camera).toarray()
    noise = variance * np.eye(camera.measurements)
    gain = 5461.25 * designed.T @ np.linalg.inv(5461.25 * designed @ designed.T + noise)
    expected = 5461.25 * np.square(np.eye(camera.unknowns) - gain @ designed).sum()
    costs: list[float] = []
    for table in tables.reshape(-1, *tables.shape[2:]):
        seen = gain @ misaligned_matrix(camera, table).toarray()
        off = gain @ (designed @ prior.mean) - seen @ prior.mean
        error = 5461.25 * np.square(np.eye(camera.unknowns) - seen).sum() + np.square(off).sum()
        costs.append(float(error - expected) / camera.unknowns)
    means = np.mean(np.reshape(costs, tables.shape[:2]), axis=1)
    return float(means.mean()), float(means.std(ddof=1)) / means.size**0.5


def random_misalignments(camera: Camera, groups: int, cameras: int) -> FloatArray:
    """Normal misalignments, in every group one of each sub-imager's in each of equally likely intervals."""
    spread, rng = tolerances(camera), np.random.default_rng(3)
    order = rng.permuted(np.broadcast_to(np.arange(cameras)[:, None, None], (groups, cameras, *spread.shape)), axis=1)
    return spread * stats.norm.ppf((order + rng.random(order.shape)) / cameras)


@pytest.mark.parametrize(
    "tolerance",
    [
        {"position": "20 nm"},
        pytest.param({"rotation": "0.1 deg"}, marks=pytest.mark.slow),
        pytest.param({"focal_length": 1e-3}, marks=pytest.mark.slow),
    ],
    ids=lambda each: next(iter(each)),
)
def test_the_cost_of_one_tolerance_is_that_of_random_cameras(tolerance: dict[str, float | str]) -> None:
    """Points whose second moments are a quarter too large fail."""
    camera = misaligned_camera(tolerance=tolerance)
    mean, error = mean_over(camera, random_misalignments(camera, 10, 12))
    assert cost_of(camera) == pytest.approx(mean, abs=3 * error)
    assert error < 0.03 * mean, "too few cameras to tell"


@pytest.mark.slow
def test_predict_includes_the_cost(ommatid: Command) -> None:
    tile = (GALLERY / "tile19.toml", "--no-rays", "--set", "noise.variance=1e-2")
    (strict,) = document(ommatid("predict", *tile, "--json"))
    (loose,) = document(ommatid("predict", *tile, "--set", 'camera.tolerance.position="10 nm"', "--json"))
    assert "misalignment" not in strict
    assert loose["mse"] == pytest.approx(strict["mse"] + loose["misalignment"], rel=1e-6)
    assert loose["misalignment"] > 1
    assert "from misalignment" in ommatid("predict", *tile, "--set", 'camera.tolerance.position="10 nm"').out
    tolerant = ("--set", 'camera.tolerance.position="41 nm"')
    (designed,) = document(ommatid("predict", *tile, *tolerant, "--json"))
    (fitted,) = document(ommatid("predict", *tile, *tolerant, "--set", "estimator.misalignment=fit", "--json"))
    assert fitted["budget"]["misalignment"] < 0.1 * designed["budget"]["misalignment"], "H is fitted to the readings"


@pytest.mark.slow
def test_predict_with_saturated_pixels_and_with_blurred_lenses(ommatid: Command) -> None:
    """Saturated pixels are left out of both; a cost without closed form is reported as missing."""
    loose = ("--set", 'camera.tolerance.position="10 nm"')
    aperture = ["--set", "camera.lens.*.aperture=0.4 mm", "--set", "camera.wavelength=none"]
    sensor = ("--set", "noise=", "--set", 'sensor.illuminance="500 lux"', "--set", 'sensor.exposure="10 ms"')
    (bright,) = document(ommatid("predict", "--no-rays", GALLERY / "tile19.toml", *aperture, *sensor, *loose, "--json"))
    assert bright["measurements"] < 706
    assert bright["misalignment"] > 0
    known = ("--set", "prior.kind=independent")  # a fitted prior takes a stack
    lens = ommatid("predict", "--no-rays", GALLERY / "doublet.toml", *loose, *known)
    assert lens.code == 0
    assert "not included" in lens.out
    assert "not included" not in ommatid("predict", "--no-rays", GALLERY / "tile19.toml", *loose).out
