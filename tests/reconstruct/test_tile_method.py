"""Tiles with a halo, and tiles that are merged: each against the dense estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from ommatid.reconstruct.forms.square_root import Indices
from ommatid.reconstruct.frame import conjugate_gradients
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.methods.tile_solver import (
    Posterior,
    disjoint_tiles,
    merge_posteriors,
    merge_tiles,
    overlapping_tiles,
    tile_posterior,
)
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.cluster import worker_pool
from ommatid.scenes.scene import Scene
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from ommatid.stability.exact_answer import exact_answer

from ..examples import Lenses, camera, not_none, with_optics
from ..frames import drawn, recorded, wide

NOISE = 1e-2


def task_of(scene: Scene, truth: FloatArray, seed: int = 0) -> EstimationTask:
    stack = recorded(scene, truth, NOISE, seed)
    expected = np.broadcast_to(np.float64(NOISE), stack.values.shape)
    used = np.ones(stack.values.size, dtype=np.bool_)
    model = ideal_model(scene, stack.camera)
    return EstimationTask(model, stack.values, used, expected, scene.prior, scene.estimator, scene.tiles)


def test_without_a_solution_of_the_frame_tiles_state_no_expectation(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = wide((50, 46), noise={"variance": NOISE}, estimator={"method": "tiles"})
    stack = recorded(scene, drawn((50, 46)), NOISE)
    found = restore(stack, ideal_model(scene, stack.camera))
    assert found.solver.method.startswith("tiles")
    given = not_none(found.given_estimate())
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
    assert not_none(result.interval).low < np.mean((result.image - truth) ** 2) < not_none(result.interval).high
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


# --- tiles that are merged


SMALL: Lenses = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))
DEVIATION = 5461.25**0.5


def frame(shape: tuple[int, int], lenses: Lenses, noise: float) -> tuple[Problem, FloatArray]:
    """A frame of random pixels under the paper's prior, and its measurements."""
    matrix = ideal_matrix(camera(shape, lenses))
    rng = np.random.default_rng(0)
    problem = Problem(matrix, independent(127.5, 5461.25, matrix.shape[1]), np.full(matrix.shape[0], noise))
    return problem, matrix @ rng.uniform(0, 255, problem.unknowns) + rng.normal(0, noise**0.5, problem.measurements)


def random_chain(seed: int) -> tuple[Problem, FloatArray, list[Indices]]:
    """A random problem of local measurements in 2 to 4 tiles, with known pixels and noise over six decades."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(4, 13)), int(rng.integers(1, 25))
    dense = np.zeros((m, n))
    for row in dense:
        start, width = int(rng.integers(n)), int(rng.integers(1, 5))
        row[start : start + width] = rng.integers(-3, 4, row[start : start + width].size) / rng.choice([1.0, 3.0])
    prior = Prior(rng.normal(size=n), 10.0 ** rng.uniform(-1, 2, n) * (rng.random(n) > 0.1))
    problem = Problem(sparse.csr_array(dense), prior, 10.0 ** rng.uniform(-4, 2, m))
    image = prior.mean + prior.root * rng.normal(size=n)
    ends = np.sort(rng.choice(np.arange(1, n), int(rng.integers(1, 4)), replace=False))
    recorded = dense @ image + problem.deviation * rng.normal(size=m)
    return problem, recorded, np.split(np.arange(n, dtype=np.intp), ends)


def assert_same(first: Posterior, second: Posterior, tolerance: float) -> None:
    """Means agree relative to the largest standard deviation, covariances relative to those of both pixels."""
    np.testing.assert_array_equal(first.pixels, second.pixels)
    deviation = np.sqrt(second.variance)
    size = max(float(np.abs(second.mean).max()), float(deviation.max()))
    np.testing.assert_allclose(first.mean, second.mean, rtol=0, atol=tolerance * size)
    difference = np.abs(first.covariance - second.covariance)
    assert (difference <= tolerance * np.outer(deviation, deviation)).all()


@pytest.mark.parametrize("noise", [1e-2, 1e-6])
def test_small_tiles_in_exact_arithmetic(noise: float) -> None:
    """Two 7 x 6 tiles, and four of 4 x 6 and 3 x 6 that meet in a corner."""
    problem, recorded = frame((7, 12), SMALL, noise)
    answer = exact_answer(problem, recorded)
    for tile in ((7, 6), (4, 6)):
        merged = merge_tiles(problem, recorded, disjoint_tiles((7, 12), tile))
        assert np.abs(answer.image.difference(merged.mean)).max() < 1e-11 * DEVIATION
        assert (np.abs(answer.variance.difference(merged.variance)) < 1e-12 * answer.variance.high).all()


@given(st.integers(0, 10**6))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_any_order_of_merging_is_exact(seed: int) -> None:
    """To 1e-9, the rounding error at the least noise variance relative to the prior of these problems, 1e-8."""
    problem, recorded, tiles = random_chain(seed)
    rng = np.random.default_rng(seed)
    parts = [tile_posterior(problem, recorded, tile) for tile in tiles]
    while len(parts) > 1:
        first, second = (parts.pop(int(rng.integers(len(parts)))) for _ in range(2))
        parts.append(merge_posteriors(first, second, problem, recorded))
    assert_same(parts[0], merge_tiles(problem, recorded, tiles), 1e-9)
    answer = exact_answer(problem, recorded)
    assert np.abs(answer.image.difference(parts[0].mean)).max() < 1e-9 * max(1.0, problem.prior.root.max())
    assert (np.abs(answer.variance.difference(parts[0].variance)) <= 1e-9 * answer.variance.high).all()


def test_dead_pixels_of_other_tiles_and_repeated_rows_have_no_effect() -> None:
    matrix = sparse.csr_array(np.array([[1.0, 1, 0, 0], [1, 1, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 1]]))
    problem = Problem(matrix, independent(4.0, 9.0, 4), np.full(5, 1e-6))
    recorded = np.array([7.0, 7.0, 9.0, 9.0, np.nan])
    first, second = (tile_posterior(problem, recorded, np.array([pixel])) for pixel in (1, 2))
    merged = merge_posteriors(first, second, problem, recorded)
    assert merged.mean == pytest.approx([4.5, 4.5], abs=1e-6)  # the excess over 4 + 4, shared equally
    assert merged.variance == pytest.approx([4.5, 4.5], abs=1e-6)
    assert merged.covariance[0, 1] == pytest.approx(-4.5, abs=1e-6)


def test_disjoint_tiles_partition_the_frame() -> None:
    tiles = disjoint_tiles((5, 7), (2, 3))
    assert [tile.size for tile in tiles] == [6, 6, 2, 6, 6, 2, 3, 3, 1]
    np.testing.assert_array_equal(np.sort(np.concatenate(tiles)), np.arange(35))
    assert tiles[1].tolist() == [3, 4, 5, 10, 11, 12]


ONES = sparse.csr_array(np.ones((2, 2)))
NOISE_FREE = Problem(ONES, independent(0.0, 1.0, 2), np.zeros(2))
CORRELATED = exponential(0.0, 1.0, (1, 2), 1.0)
EXTREME = Problem(ONES, independent(0.0, 1e308, 2), np.full(2, 1e-320))
NOISY = replace(NOISE_FREE, noise_variance=np.ones(2))
FIRST, SECOND = (tile_posterior(NOISE_FREE, np.ones(2), np.array([pixel])) for pixel in (0, 1))


@pytest.mark.parametrize(
    ("refused", "words"),
    [
        (lambda: merge_posteriors(FIRST, SECOND, NOISE_FREE, np.ones(2)), "with noise only"),
        (lambda: merge_posteriors(FIRST, FIRST, NOISE_FREE, np.ones(2)), "do not overlap"),
        (lambda: merge_posteriors(FIRST, SECOND, NOISY, np.array([1.0, np.nan])), "dead pixels"),
        (lambda: tile_posterior(replace(NOISY, prior=CORRELATED), np.ones(2), np.array([0])), "independent pixels"),
        *(
            (lambda wrong=wrong: tile_posterior(NOISY, np.ones(2), np.array(wrong, dtype=np.intp)), "each once")
            for wrong in ([], [0, 0], [2], [-1])
        ),
        (lambda: tile_posterior(EXTREME, np.ones(2), np.array([0, 1])), "double precision"),
    ],
)
def test_invalid_tiles_and_measurements_are_refused(refused: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        refused()
