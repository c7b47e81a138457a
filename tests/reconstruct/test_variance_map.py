"""Maps of the error of every pixel of a frame, against dense inverses and exact solutions for single pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.frame.error_map import ExactVariances, check_map, error_map, map_by_bands
from ommatid.reconstruct.frame.swept import swept_maps
from ommatid.reconstruct.frame.windows import Windows, by_windows, of_mean_kernels, windows_map
from ommatid.reconstruct.methods.method import EstimationTask
from ommatid.reconstruct.prior import reflecting_root
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Entries, Observation
from ommatid.scenes.scene import Scene
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import slow
from ..frames import P0, blurred, frame_camera, frame_system, observed, precision, wide, with_apertures

STATED = 1e-3  # relative accuracy of the maps of independent pixels
CORRELATED: dict[str, Any] = {"prior": {"kind": "exponential", "variance": 2000.0, "correlation_length": "8 mm"}}


def task_of(scene: Scene, noise: FloatArray | float = 1e-2) -> EstimationTask:
    """The task of a scene whose measurements are not asked for; noise : (M,), or the same of all."""
    model = ideal_model(scene, derive(scene))
    count, tables = model.measurements, (scene.prior, scene.estimator, scene.tiles)
    expected = np.broadcast_to(noise, count).astype(np.float64)
    return EstimationTask(model, np.zeros(count), np.ones(count, np.bool_), expected, *tables)


def system_of(task: EstimationTask) -> FrameSystem:
    prior = 1 / np.asarray(task.precision_on(task.shape))
    return frame_system(task.model.camera, 1 / task.expected_noise, prior if prior.ndim else float(prior))


def uneven(task: EstimationTask, decades: float) -> FloatArray:
    """Noise variances from 1e-2 on, over some decades: (M,)."""
    return 1e-2 * 10 ** np.random.default_rng(0).uniform(0, decades, task.model.measurements)


def exact_at(task: EstimationTask, place: tuple[int, int]) -> float:
    unit = np.zeros(task.shape)
    unit[place] = 1.0
    return float(system_of(task).solve(unit.ravel(), 1e-6).image.reshape(task.shape)[place])


@pytest.mark.parametrize(
    ("case", "shape", "noise", "decades", "accuracy"),
    [
        ("independent", (64, 71), 1e-2, 0.0, 5 * STATED),
        ("independent", (61, 64), 1e-2, 1.0, 1e-3),
        ("apertures", (36, 35), 1e-2, 0.0, 5e-3),
        ("correlated", (59, 59), 1e-2, 0.0, 5e-3),
        *(
            slow(*values)
            for values in (
                *(("independent", (119, 119), noise, 0.0, 5 * STATED) for noise in (1e-6, 1e-2, 10.0)),
                ("apertures", (47, 46), 1e-2, 0.0, 5e-3),
                ("independent", (119, 90), 1e-2, 3.0, 2e-2),
                ("correlated", (119, 119), 1e-2, 2.0, 2e-2),
            )
        ),
    ],
)
def test_frames_at_single_pixels(
    case: str, shape: tuple[int, int], noise: float, decades: float, accuracy: float
) -> None:
    """At corners, at edges, near them and in the middle, with and without pixels outside some lens types' field.

    Uneven noise of every measurement by windows; even noise by strips, and by small frames.
    """
    scene = wide(shape, **(CORRELATED if case == "correlated" else {}))
    task = task_of(with_apertures(scene) if case == "apertures" else scene)
    task = replace(task, expected_noise=uneven(task, decades) * noise / 1e-2)
    found, (rows, columns) = error_map(task, system_of(task), task.expected_noise), shape
    variance, places = found.variances.variance.reshape(shape), [(0, 0), (rows // 2, columns // 2), (7, 21)]
    places += [(rows - 1, columns // 3), (rows - 13, 2)]
    if (case, decades) == ("independent", 0.0):
        assert found.check.worst < STATED
        places += [(0, 50), (1, 2), (rows - 1, 5), (rows - 2, columns - 3), (4, 60), (rows // 2, columns - 1), (17, 40)]
        places += [(19, 19), (20, 55), (22, 24), (rows // 3, 19), (rows - 1, columns - 1)]
    for place in places:
        assert variance[place] == pytest.approx(exact_at(task, place), rel=accuracy), place


@pytest.mark.parametrize("case", ["small frame", "strips", "windows", "sweep"])
def test_actual_noise_that_differs_from_the_expected_one(case: str) -> None:
    """All parts of Eq. 5 against dense matrices, on a frame that is covered as a whole."""
    shape = 28, 25
    task = task_of(wide(shape, **(CORRELATED if case in ("small frame", "windows") else {})))
    types = task.model.camera.types
    noise = np.concatenate(
        [np.full(each.measurements, value) for each, value in zip(types, (1e-4, 1e-3, 1e-2), strict=True)]
    )
    system, matrix = system_of(task), task.model.to_sparse()
    if case == "sweep":
        maps = swept_maps(matrix, system.weights, noise / 1e-2, 1 / P0, shape, 5)
    else:
        make = windows_map(task, system.weights, system.bands, noise, 28) if case == "windows" else None
        found = map_by_bands(task, system, noise, "swept" if case == "strips" else "edges") if make is None else make
        maps = np.array([found.posterior, found.missing, found.noisy])
    prior = np.eye(shape[0] * shape[1]) / P0
    if case in ("small frame", "windows"):
        root = reflecting_root(np.asarray(1 / np.asarray(task.precision_on(shape))))
        prior = linalg.inv(root @ root.T)
    covariance = linalg.inv(precision(matrix, system.weights, 0.0) + prior)
    gram = precision(matrix, 1e4 * noise, 0.0)
    expected = covariance, covariance @ prior @ covariance, covariance @ gram @ covariance
    for part, each in zip(maps, expected, strict=True):
        np.testing.assert_allclose(part.ravel(), np.diagonal(each), rtol=2e-4)


def test_one_sweep_serves_any_h_and_any_noise() -> None:
    """H with errors and noise over a decade, against the dense inverse."""
    shape = (36, 31)
    model, _ = blurred(wide(shape, (("1/4", [2, 3], "fit"), ("1/3", [3, 3], "fit"))), 0.004)
    weights = 10 ** np.random.default_rng(1).uniform(1, 2, model.measurements)
    found = swept_maps(model.matrix, weights, np.ones(weights.size), 1 / P0, shape, model.windowed.reach)
    dense = precision(model.matrix, weights, 1 / P0)
    np.testing.assert_allclose(found[0].ravel(), np.diagonal(linalg.inv(dense)), rtol=1e-8)


UNEVEN = np.array([[1.0, 0.04, -0.02, -0.1, 0.02, -0.07]])  # a Legendre polynomial over the field


def test_kernels_that_vary_over_the_field() -> None:
    """To 1 % of a deviation where the light varies by a quarter, at corners, edges and elsewhere: exact solutions."""
    shape = 83, 90
    task = task_of(with_apertures(wide(shape)))
    observation = observed(task.model.camera)
    parts = [
        replace(
            part,
            degree=2,
            coefficients=part.coefficients[:, :1] * UNEVEN,
            error_coefficients=np.zeros((0, 0, UNEVEN.size)),
        )
        for part in observation.parts[:1]
        if isinstance(part, KernelFootprints)
    ]
    observation = replace(observation, parts=(*parts, *observation.parts[1:]))
    system = replace(system_of(task), observation=observation)
    maps = map_by_bands(task, system, task.expected_noise, "edges")
    variance = by_windows(maps, task, observation, task.expected_noise, of_mean_kernels(observation)).posterior
    for place in ((0, 0), (41, 44), (41, 0), (82, 30), (20, 60), (60, 89), (5, 70), (70, 12)):
        unit = np.zeros(shape)
        unit[place] = 1.0
        solved = system.solve(unit.ravel(), 1e-6).image.reshape(shape)
        assert variance[place] == pytest.approx(solved[place], rel=0.02), place


@pytest.mark.parametrize("shape", [(36, 31), slow((60, 47))])
def test_some_windows_give_the_mean_error_of_another_camera(shape: tuple[int, int]) -> None:
    """To 2 % of all windows, where a shift-invariant camera is a tenth off: arrays other than m x m."""
    odd = (("1/3", [3, 2], "fit"), ("1/4", [4, 4], "fit"), ("1/5", [4, 5], "fit"))
    task = task_of(wide(shape, odd, **CORRELATED), 1.0)
    system = system_of(task)
    like = map_by_bands(task, system, task.expected_noise, "edges")
    found = by_windows(like, task, task.model.applied, task.expected_noise)
    every = windows_map(task, system.weights, system.bands, task.expected_noise, 8)
    assert found.variance.mean() == pytest.approx(every.variance.mean(), rel=0.02)
    assert like.variance.mean() < 0.93 * every.variance.mean()


@pytest.mark.parametrize("shape", [(44, 38), slow((60, 47))])
@pytest.mark.parametrize(
    ("decades", "halo", "worst", "mean"), [(0.0, 6, 1.5e-2, 3e-3), (1.0, 8, 1.5e-2, 3e-3)], ids=["even", "uneven"]
)
def test_windows_are_corrected_by_some_with_a_longer_halo(
    decades: float, halo: int, worst: float, mean: float, shape: tuple[int, int]
) -> None:
    """Every pixel of a frame whose lens types see it otherwise everywhere, against the dense inverse."""
    odd = (("1/3", [3, 2], "fit"), ("1/4", [4, 4], "fit"), ("1/5", [4, 5], "fit"))
    task = task_of(wide(shape, odd, **CORRELATED))
    task = replace(task, expected_noise=100 * uneven(task, decades))
    system = system_of(task)
    found = windows_map(task, system.weights, system.bands, task.expected_noise, halo).variance.reshape(shape)
    root = reflecting_root(np.asarray(1 / np.asarray(task.precision_on(shape))))
    exact = precision(task.model.to_sparse(), system.weights, 0.0) + linalg.inv(root @ root.T)
    ratio = found / np.diagonal(linalg.inv(exact)).reshape(shape)
    assert np.abs(ratio - 1).max() < worst
    assert ratio.mean() == pytest.approx(1, abs=mean)


def test_windows_of_entries_are_those_of_the_same_h_by_lens_types() -> None:
    """Entries of a calibration are one part for all lens types."""
    task = task_of(wide((29, 26), **CORRELATED))
    windows, observation = Windows(task, task.expected_noise, (12, 12), 8), task.model.applied
    entries = Observation(observation.shape, (Entries(observation.to_sparse(), observation.shape),))
    found, expected = windows.frame(entries), windows.frame(observation)
    np.testing.assert_allclose(found.posterior, expected.posterior, rtol=1e-9)
    np.testing.assert_allclose(found.variance, expected.variance, rtol=1e-9)


@pytest.mark.parametrize(("as_expected", "shape"), [(False, (36, 31)), slow(False, (47, 41)), slow(True, (47, 41))])
def test_one_solution_measures_the_variances_of_distant_pixels(as_expected: bool, shape: tuple[int, int]) -> None:
    """Against the dense Eq. 5, and a map that is 5 % off, or is none at a pixel that the check misses, is found."""
    task = task_of(wide(shape))
    expected = uneven(task, 1)
    actual = expected if as_expected else expected[::-1].copy()
    weights, matrix = 1 / expected, ideal_matrix(task.model.camera)
    covariance = linalg.inv(precision(matrix, weights, 1 / P0))
    gain = covariance @ (matrix.T.toarray() * weights)
    error = np.square(covariance).sum(axis=1) / P0 + np.square(gain) @ actual
    system = frame_system(frame_camera(shape), weights)
    exact = ExactVariances(system, None if as_expected else weights**2 * actual, 0.01, task)
    posterior = np.ascontiguousarray(np.diagonal(covariance))
    assert check_map(error, posterior, shape, exact, local=True).worst < 2e-3
    wrong = check_map(1.05 * error, posterior, shape, exact, local=True)
    assert wrong.worst == pytest.approx(0.05, abs=3e-3)
    assert wrong.mean == pytest.approx(0.05, abs=3e-3)
    for none in (0.0, -np.inf, np.nan):
        changed = np.where(np.arange(error.size) == 200, none, error)
        assert check_map(changed, posterior, shape, exact, local=True).worst >= 1.0
