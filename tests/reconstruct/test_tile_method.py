"""Tiles: they share out the frame, each is the dense estimate of what it sees, and its error is what Eq. 5 says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.methods.tile_solver import cut
from ommatid.runtime.pool import worker_pool
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.estimation import TilesTable
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..frames import FITTED, P0, precision, recorded, wide

NOISE = 1e-2


def task_of(one: Scene, truth: np.ndarray, model: Model | None = None, **changes: object) -> EstimationTask:
    stack = recorded(one, truth, NOISE)
    believed = np.broadcast_to(np.float64(NOISE), stack.values.shape)
    used = np.ones(stack.values.size, dtype=np.bool_)
    model = ideal_model(one, stack.camera) if model is None else model
    return replace(EstimationTask(model, stack.values, used, believed, one.prior, one.estimator, one.tiles), **changes)  # type: ignore[arg-type]


def drawn(one: Scene, shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return one.prior.mean + np.random.default_rng(seed).normal(0, P0**0.5, shape[0] * shape[1])


@given(st.integers(1, 150), st.integers(1, 150), st.integers(4, 40), st.integers(0, 19))
@settings(max_examples=200)
def test_cores_share_out_the_frame(rows: int, columns: int, size: int, overlap: int) -> None:
    if 2 * overlap >= size:
        return
    count = np.zeros((rows, columns), dtype=int)
    for tile in cut((rows, columns), size, overlap):
        count[tile.core] += 1
        assert max(tile.shape) <= size
        for window, core, length in zip(tile.window, tile.core, (rows, columns), strict=True):
            assert core.start - window.start >= overlap or window.start == 0
            assert window.stop - core.stop >= overlap or window.stop == length
        assert tile.kept.size == count[tile.core].size
    assert (count == 1).all()


def test_one_tile_is_the_dense_estimate() -> None:
    one = wide((30, 28))
    truth = drawn(one, (30, 28))
    task = task_of(one, truth)
    noise = {"noise": task.expected_noise}
    dense, tiled = (
        DenseMethod(task, Execution()).result(noise, truth),
        TileMethod(task, Execution()).result(noise, truth),
    )
    np.testing.assert_allclose(tiled.image, dense.image, rtol=1e-12)
    np.testing.assert_allclose(tiled.expected.variance, dense.expected.variance, rtol=1e-12)
    assert tiled.expected.missing == pytest.approx(dense.expected.missing)
    assert tiled.expected.parts == pytest.approx(dense.expected.parts)
    weights = np.random.default_rng(0).normal(size=truth.size)
    assert tiled.variance_of_sum(weights) == pytest.approx(dense.variance_of_sum(weights))
    assert tiled.interval is not None
    assert dense.interval is not None
    assert tiled.interval.mse == pytest.approx(dense.interval.mse)
    assert tiled.interval.low < dense.interval.low < dense.interval.high < tiled.interval.high  # on the safe side


@pytest.mark.parametrize("own", [False, True], ids=["shared", "each its own"])
def test_tiles_of_35_less_8_are_near_the_exact_answer(own: bool) -> None:
    """Within 0.17 posterior standard deviations on average where all types see all edges."""
    one = wide((59, 59))
    truth = drawn(one, (59, 59))
    task = task_of(one, truth)
    if own:
        model = replace(task.model, record={"method": "points"})  # nothing is known of which windows are alike
        task = replace(task, model=model)
    matrix = ideal_matrix(task.model.camera)
    dense = precision(matrix, np.full(matrix.shape[0], 1 / NOISE), 1 / P0)
    exact = one.prior.mean + linalg.solve(dense, matrix.T @ ((task.recorded - 127.5 * matrix.sum(axis=1)) / NOISE))
    deviation = np.sqrt(np.diagonal(linalg.inv(dense)))
    assert np.sqrt(np.mean(((TileMethod(task, Execution()).image - exact) / deviation) ** 2)) < 0.17


def test_tiles_that_see_the_same_share_a_factorisation() -> None:
    one = wide((151, 140))
    task = task_of(one, drawn(one, (151, 140)))
    groups = TileMethod(task, Execution()).groups({})
    assert len(cut((151, 140), 35, 8)) == 56
    assert len(groups) < 20
    assert sum(map(len, groups)) == 56


def test_their_error_is_the_expected_one() -> None:
    """The whole of it, of sums of pixels, and in its interval given the image; noise of two kinds adds up."""
    shape = (40, 36)
    one = wide(shape, tiles={"size": 20, "overlap": 4})
    squares: list[float] = []
    sums: list[float] = []
    inside, count = False, 24
    weights = np.zeros(shape)
    weights[10:22, 5:35] = 1 / 360  # over several tiles
    outcome = None
    for seed in range(count):
        truth = drawn(one, shape, seed)
        stack = recorded(one, truth, NOISE, seed)
        task = replace(task_of(one, truth), recorded=stack.values)
        noise = {
            "noise": 0.7 * task.expected_noise,
            "rendering": np.broadcast_to(0.3 * NOISE, task.expected_noise.shape),
        }
        if seed == 0:
            outcome = TileMethod(task, Execution()).result(noise, truth)
            assert outcome.interval is not None
            inside = outcome.interval.low < np.mean((outcome.image - truth) ** 2) < outcome.interval.high
        image = TileMethod(task, Execution()).image
        squares.append(float(np.mean((image - truth) ** 2)))
        sums.append(float(weights.ravel() @ (image - truth)) ** 2)
    assert inside
    assert outcome is not None
    expected, of_sum = outcome.expected, outcome.variance_of_sum(weights.ravel())
    assert np.mean(squares) == pytest.approx(expected.mse, abs=4 * float(np.std(squares)) / count**0.5)
    assert np.mean(sums) == pytest.approx(of_sum, rel=4 * (2 / count) ** 0.5)
    assert expected.mse == pytest.approx(expected.missing + sum(expected.parts.values()))
    assert expected.parts["noise"] / expected.parts["rendering"] == pytest.approx(7 / 3)


def test_who_does_them_changes_no_bit() -> None:
    one = wide((75, 67))
    truth = drawn(one, (75, 67))
    task = task_of(one, truth)
    task = replace(task, expected_noise=NOISE * np.random.default_rng(0).uniform(1, 2, task.expected_noise.size))
    alone = TileMethod(task, Execution()).image
    for threads in (1, 3):
        with worker_pool(threads=threads) as several:
            np.testing.assert_array_equal(TileMethod(task, Execution(several)).image, alone)
    with worker_pool(count=2) as processes:
        found = TileMethod(task, Execution(processes)).result({"noise": task.expected_noise}, truth)
    here = TileMethod(task, Execution()).result({"noise": task.expected_noise}, truth)
    np.testing.assert_array_equal(found.image, alone)
    np.testing.assert_array_equal(found.expected.variance, here.expected.variance)
    assert found.interval == here.interval


def test_dead_pixels_are_left_out() -> None:
    one = wide((50, 47), FITTED, tiles=TilesTable(size=30, overlap=6).model_dump())
    truth = drawn(one, (50, 47))
    task = task_of(one, truth)
    used = np.random.default_rng(0).uniform(size=task.used.size) > 0.02
    spoilt = np.where(used, task.recorded, np.nan)
    some = replace(task, used=used, recorded=spoilt, expected_noise=task.expected_noise[used])
    found = TileMethod(some, Execution()).result({"noise": some.expected_noise}, truth)
    assert np.isfinite(found.image).all()
    assert found.multipliers.shape == (used.sum(),)
    assert found.expected.mse > TileMethod(task, Execution()).result({"noise": task.expected_noise}, None).expected.mse
