"""Tiles: cores partition the frame, each tile is the dense estimate of its window, and the error is that of Eq. 5."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ommatid.reconstruct.frame import conjugate_gradients
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.methods.tile_solver import overlapping_tiles
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.cluster import worker_pool
from ommatid.scenes.scene import Scene
from ommatid.simulate.ideal import ideal_model

from ..examples import with_optics
from ..frames import drawn, recorded, wide

NOISE = 1e-2


def task_of(scene: Scene, truth: FloatArray, seed: int = 0) -> EstimationTask:
    stack = recorded(scene, truth, NOISE, seed)
    expected = np.broadcast_to(np.float64(NOISE), stack.values.shape)
    used = np.ones(stack.values.size, dtype=np.bool_)
    model = ideal_model(scene, stack.camera)
    return EstimationTask(model, stack.values, used, expected, scene.prior, scene.estimator, scene.tiles)


def test_tiles_of_a_frame_that_conjugate_gradients_do_not_solve_state_no_expectation_for_their_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = wide((50, 46), noise={"variance": NOISE}, estimator={"method": "tiles"})
    stack = recorded(scene, drawn((50, 46)), NOISE)
    found = restore(stack, ideal_model(scene, stack.camera))
    assert found.solver.method.startswith("tiles")
    given = found.given_estimate()
    assert given is not None
    assert 0 < given < found.expected.mse
    monkeypatch.setattr(conjugate_gradients, "MAX_STEPS", 1)
    assert found.given_estimate() is None


@given(st.integers(1, 150), st.integers(1, 150), st.integers(4, 40), st.integers(0, 19))
@settings(max_examples=200)
def test_cores_partition_the_frame(rows: int, columns: int, size: int, overlap: int) -> None:
    if 2 * overlap >= size:
        return
    count = np.zeros((rows, columns), dtype=int)
    for tile in overlapping_tiles((rows, columns), size, overlap):
        count[tile.core] += 1
        assert max(tile.shape) <= size
        for window, core, length in zip(tile.window, tile.core, (rows, columns), strict=True):
            assert core.start - window.start >= overlap or window.start == 0
            assert window.stop - core.stop >= overlap or window.stop == length
        assert tile.kept.size == count[tile.core].size
    assert (count == 1).all()


def test_one_tile_is_the_dense_estimate() -> None:
    scene = wide((30, 28), prior={"level": "known"})
    truth = drawn((30, 28))
    task = task_of(scene, truth)
    noise = {"noise": task.expected_noise}
    dense, tiled = (method(task, Execution()).result(noise, truth) for method in (DenseMethod, TileMethod))
    np.testing.assert_allclose(tiled.image, dense.image, rtol=1e-12)
    np.testing.assert_allclose(tiled.expected.variance, dense.expected.variance, rtol=1e-12)
    assert tiled.expected.missing == pytest.approx(dense.expected.missing)
    assert tiled.expected.parts == pytest.approx(dense.expected.parts)
    weights = np.random.default_rng(0).normal(size=truth.size)
    assert tiled.variance_of_sum(weights) == pytest.approx(dense.variance_of_sum(weights))
    assert tiled.interval is not None
    assert dense.interval is not None
    assert tiled.interval.mse == pytest.approx(dense.interval.mse)
    assert tiled.interval.low < dense.interval.low < dense.interval.high < tiled.interval.high  # conservative


def test_tiles_into_which_no_measurement_fits_are_refused_and_never_chosen() -> None:
    """They would be the prior's mean, whose error bars are right and of no use."""
    task = task_of(wide((30, 28), tiles={"size": 4, "overlap": 0}), drawn((30, 28)))
    with pytest.raises(InputError, match=r"see up to 5 pixels of f, tiles have 4; raise tiles.size above 5"):
        TileMethod(task, Execution())
    ways = (("1/3", [3, 3], "fit"), "frame"), (("2/7", [2, 2], "fit"), "dense")
    for lens, method in ways:
        blurred, camera = with_optics({"aperture": "0.4 mm"}, {"lens_pitch": "1 mm"}, (lens,), (65, 65))
        assert choose_method(blurred, camera, exact=False).method == method


def test_separate_factorisations_give_the_same_image() -> None:
    scene = wide((40, 36), tiles={"size": 20, "overlap": 4})
    task = task_of(scene, drawn((40, 36)))
    calibrated = replace(task, model=replace(task.model, record={"method": "points"}))
    shared, separate = (TileMethod(variant, Execution()).image for variant in (task, calibrated))
    np.testing.assert_allclose(separate, shared, rtol=1e-9)


@pytest.mark.slow
def test_the_error_of_tiles_is_the_expected_one() -> None:
    """The mean squared error and the variance of a sum over several tiles, each within 4 standard errors."""
    shape, count = (40, 36), 24
    scene = wide(shape, tiles={"size": 20, "overlap": 4})
    squares: list[float] = []
    sums: list[float] = []
    weights = np.zeros(shape)
    weights[10:22, 5:35] = 1 / 360
    truth = drawn(shape)
    task = task_of(scene, truth)
    rendering = np.broadcast_to(0.3 * NOISE, task.expected_noise.shape)
    result = TileMethod(task, Execution()).result({"noise": 0.7 * task.expected_noise, "rendering": rendering}, truth)
    assert result.interval is not None
    assert result.interval.low < np.mean((result.image - truth) ** 2) < result.interval.high
    for seed in range(count):
        truth = drawn(shape, seed)
        error = TileMethod(task_of(scene, truth, seed), Execution()).image - truth
        squares.append(float(np.mean(error**2)))
        sums.append(float(weights.ravel() @ error) ** 2)
    expected = result.expected
    assert np.mean(squares) == pytest.approx(expected.mse, abs=4 * float(np.std(squares)) / count**0.5)
    assert np.mean(sums) == pytest.approx(result.variance_of_sum(weights.ravel()), rel=4 * (2 / count) ** 0.5)
    assert expected.mse == pytest.approx(expected.missing + sum(expected.parts.values()))
    assert expected.parts["noise"] / expected.parts["rendering"] == pytest.approx(7 / 3)


@pytest.mark.slow
def test_threads_and_processes_give_identical_results() -> None:
    scene = wide((75, 67))
    truth = drawn((75, 67))
    task = task_of(scene, truth)
    task = replace(task, expected_noise=NOISE * np.random.default_rng(0).uniform(1, 2, task.expected_noise.size))
    noise = {"noise": task.expected_noise}
    result = TileMethod(task, Execution()).result(noise, truth)
    np.testing.assert_array_equal(TileMethod(task, Execution()).image, result.image)
    for threads in (1, 3):
        with worker_pool(threads=threads) as workers:
            np.testing.assert_array_equal(TileMethod(task, Execution(workers)).image, result.image)
    with worker_pool(count=2) as processes:
        distributed = TileMethod(task, Execution(processes)).result(noise, truth)
    np.testing.assert_array_equal(distributed.image, result.image)
    np.testing.assert_array_equal(distributed.expected.variance, result.expected.variance)
    assert distributed.interval == result.interval


def test_dead_pixels_are_skipped() -> None:
    scene = wide((28, 20), tiles={"size": 20, "overlap": 6})
    truth = drawn((28, 20))
    task = task_of(scene, truth)
    used = np.random.default_rng(0).uniform(size=task.used.size) > 0.02
    recorded_values = np.where(used, task.recorded, np.nan)
    fewer = replace(task, used=used, recorded=recorded_values, expected_noise=task.expected_noise[used])
    result = TileMethod(fewer, Execution()).result({"noise": fewer.expected_noise}, truth)
    complete = TileMethod(task, Execution()).result({"noise": task.expected_noise}, None)
    assert np.isfinite(result.image).all()
    assert result.multipliers.shape == (used.sum(),)
    assert result.expected.mse > complete.expected.mse
