"""Tiles merged by Eq. 7 against the joint problem, solved by other methods and in exact arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from ommatid.reconstruct.forms.square_root import Indices
from ommatid.reconstruct.methods.tile_solver import (
    Posterior,
    disjoint_tiles,
    merge_posteriors,
    merge_tiles,
    tile_posterior,
)
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.simulate.ideal import ideal_matrix
from ommatid.stability.exact_answer import exact_answer

from ..examples import Lenses, camera

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


@given(st.integers(0, 10**6))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_merging_never_raises_a_variance_and_one_tile_is_the_whole(seed: int) -> None:
    problem, recorded, tiles = random_chain(seed)
    whole = tile_posterior(problem, recorded, np.arange(problem.unknowns)[::-1])
    assert_same(merge_tiles(problem, recorded, tiles), whole, 1e-9)
    for tile in tiles:
        assert (whole.variance[tile] <= tile_posterior(problem, recorded, tile).variance * (1 + 1e-12)).all()


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


def test_invalid_tiles_and_measurements_are_refused() -> None:
    matrix = sparse.csr_array(np.ones((2, 2)))
    noise_free = Problem(matrix, independent(0.0, 1.0, 2), np.zeros(2))
    recorded = np.ones(2)
    first, second = (tile_posterior(noise_free, recorded, np.array([pixel])) for pixel in (0, 1))
    with pytest.raises(InputError, match="with noise only"):
        merge_posteriors(first, second, noise_free, recorded)
    with pytest.raises(InputError, match="do not overlap"):
        merge_posteriors(first, first, noise_free, recorded)
    noisy = Problem(matrix, noise_free.prior, np.ones(2))
    with pytest.raises(InputError, match="dead pixels"):
        merge_posteriors(first, second, noisy, np.array([1.0, np.nan]))
    correlated = Problem(matrix, exponential(0.0, 1.0, (1, 2), 1.0), np.ones(2))
    with pytest.raises(InputError, match="independent pixels"):
        tile_posterior(correlated, recorded, np.array([0]))
    for wrong in ([], [0, 0], [2], [-1]):
        with pytest.raises(InputError, match="each once"):
            tile_posterior(noisy, recorded, np.array(wrong, dtype=np.intp))
    extreme = Problem(matrix, independent(0.0, 1e308, 2), np.full(2, 1e-320))
    with pytest.raises(InputError, match="double precision"):
        tile_posterior(extreme, recorded, np.array([0, 1]))
