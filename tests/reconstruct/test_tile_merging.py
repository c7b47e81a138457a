"""Tiles joined by Eq. 7 against their joined problem, solved anew, by other methods and in exact arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from ommatid.reconstruct.estimator.certificate import exact_variances
from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.estimator.residuals import ExactResiduals
from ommatid.reconstruct.methods.tile_merging import Posterior, alone, cut, merge, sweep
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.errors import InputError
from ommatid.simulate.ideal import ideal_matrix
from ommatid.stability.exact_answer import exact_answer

from ..examples import Lenses, camera

Vector = NDArray[np.float64]
THREE: Lenses = (("1/3", [3, 3], "fit"), ("1/5", [5, 5], "fit"), ("1/4", [4, 4], "fit"))
TILE = (19, 19)
DEVIATION = 5461.25**0.5


def frame(shape: tuple[int, int], lenses: Lenses, noise: float) -> tuple[Problem, Vector]:
    """A frame of random pixels under the paper's prior, and what is recorded of it."""
    matrix = ideal_matrix(camera(shape, lenses))
    rng = np.random.default_rng(0)
    problem = Problem(matrix, independent(127.5, 5461.25, matrix.shape[1]), np.full(matrix.shape[0], noise))
    return problem, matrix @ rng.uniform(0, 255, problem.unknowns) + rng.normal(0, noise**0.5, problem.measurements)


def chain(seed: int) -> tuple[Problem, Vector, list[NDArray[np.intp]]]:
    """A random problem whose measurements see neighbours, 2 to 4 tiles of it, known pixels, noise over six decades."""
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


def assert_same(found: Posterior, other: Posterior, tolerance: float) -> None:
    """Means beside the largest deviation, covariances beside the deviations of both pixels."""
    np.testing.assert_array_equal(found.pixels, other.pixels)
    deviation = np.sqrt(other.variance)
    size = max(float(np.abs(other.mean).max()), float(deviation.max()))
    np.testing.assert_allclose(found.mean, other.mean, rtol=0, atol=tolerance * size)
    wrong = np.abs(found.covariance - other.covariance)
    assert (wrong <= tolerance * np.outer(deviation, deviation)).all()


@pytest.mark.parametrize(
    ("lenses", "columns", "noise", "error"),
    [
        (3, 38, 1e-2, 1e-12),
        (3, 38, 1e-6, 1e-11),
        (2, 38, 1e-2, 1e-12),
        (2, 38, 1e-6, 1e-11),
        (3, 57, 1e-6, 1e-11),
        (2, 57, 1e-6, 1e-11),
    ],
)
def test_a_row_of_tiles_is_what_the_frame_solved_anew_is(lenses: int, columns: int, noise: float, error: float) -> None:
    """With two lens types H has a null space; the frame's own answer is refined in twice the precision."""
    problem, recorded = frame((19, columns), THREE[:lenses], noise)
    found = sweep(problem, recorded, cut((19, columns), TILE))
    direct = estimate(problem, recorded, "svd")
    assert direct.solver.bound is not None
    assert direct.solver.bound < error / 100
    assert found.mean == pytest.approx(direct.image, rel=0, abs=error * DEVIATION)
    some = np.random.default_rng(1).choice(problem.unknowns, 100, replace=False)
    variance, doubt = exact_variances(direct.form, ExactResiduals(problem), some)
    assert (doubt < 1e-20 * variance).all()
    assert found.variance[some] == pytest.approx(variance, rel=1e-12)
    pair = np.zeros((problem.unknowns, 2))
    pair[[0, -1], [0, 1]] = 1.0
    assert found.covariance[:, [0, -1]] == pytest.approx(direct.form.covariance(pair), rel=0, abs=1e-10)


@pytest.mark.parametrize("noise", [1e-2, 1e-6])
def test_small_tiles_in_exact_arithmetic(noise: float) -> None:
    """Two 7 x 6 tiles, and four of 4 x 6 and 3 x 6 that meet in a corner: balls of 512 bits share no formula."""
    problem, recorded = frame((7, 12), (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit")), noise)
    right = exact_answer(problem, recorded)
    for tile in ((7, 6), (4, 6)):
        found = sweep(problem, recorded, cut((7, 12), tile))
        assert np.abs(right.image.away(found.mean)).max() < 1e-11 * DEVIATION
        assert (np.abs(right.variance.away(found.variance)) < 1e-12 * right.variance.high).all()


@given(st.integers(0, 10**6))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_any_order_of_merging_is_right(seed: int) -> None:
    problem, recorded, tiles = chain(seed)
    rng = np.random.default_rng(seed)
    parts = [alone(problem, recorded, tile) for tile in tiles]
    while len(parts) > 1:
        first, second = (parts.pop(int(rng.integers(len(parts)))) for _ in range(2))
        parts.append(merge(first, second, problem, recorded))
    assert_same(parts[0], sweep(problem, recorded, tiles), 1e-9)
    right = exact_answer(problem, recorded)
    assert np.abs(right.image.away(parts[0].mean)).max() < 1e-9 * max(1.0, problem.prior.root.max())
    assert (np.abs(right.variance.away(parts[0].variance)) <= 1e-9 * right.variance.high).all()


@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_tile_is_the_whole_where_there_is_one_and_joining_never_raises_a_variance(seed: int) -> None:
    problem, recorded, tiles = chain(seed)
    whole = alone(problem, recorded, np.arange(problem.unknowns)[::-1])
    assert_same(sweep(problem, recorded, tiles), whole, 1e-9)
    for tile in tiles:
        assert (whole.variance[tile] <= alone(problem, recorded, tile).variance * (1 + 1e-12)).all()


def test_any_order_of_whole_tiles() -> None:
    problem, recorded = frame((19, 57), THREE, 1e-6)
    tiles = cut((19, 57), TILE)
    left, middle, right = (alone(problem, recorded, tile) for tile in tiles)
    found = merge(left, merge(right, middle, problem, recorded), problem, recorded)
    assert_same(found, sweep(problem, recorded, tiles), 1e-9)
    apart = merge(left, right, problem, recorded)  # nothing sees both
    np.testing.assert_array_equal(apart.variance[apart.pixels % 57 < 19], left.variance)


def test_the_errors_of_joined_tiles_are_as_large_as_their_covariance_says() -> None:
    """200 images drawn from the prior: |e|^2 in units of the covariance is chi squared with n degrees of freedom."""
    problem, _ = frame((7, 12), (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit")), 1.0)
    rng, draws, total, tiles = np.random.default_rng(3), 200, 0.0, cut((7, 12), (7, 6))
    for _ in range(draws):
        image = 127.5 + DEVIATION * rng.normal(size=84)
        found = sweep(problem, problem.matrix @ image + rng.normal(size=problem.measurements), tiles)
        total += float(np.square(np.linalg.solve(found.root, image - found.mean)).sum())
    assert abs(total - 84 * draws) < 3 * (2 * 84 * draws) ** 0.5


def test_a_dead_pixel_of_another_tile_and_rows_that_repeat_one_another_do_no_harm() -> None:
    matrix = sparse.csr_array(np.array([[1.0, 1, 0, 0], [1, 1, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 1]]))
    problem = Problem(matrix, independent(4.0, 9.0, 4), np.full(5, 1e-6))
    recorded = np.array([7.0, 7.0, 9.0, 9.0, np.nan])
    first, second = (alone(problem, recorded, np.array([pixel])) for pixel in (1, 2))
    found = merge(first, second, problem, recorded)
    assert found.mean == pytest.approx([4.5, 4.5], abs=1e-6)  # they share what is above 4 + 4
    assert found.variance == pytest.approx([4.5, 4.5], abs=1e-6)
    assert found.covariance[0, 1] == pytest.approx(-4.5, abs=1e-6)


def test_cut_is_a_partition() -> None:
    tiles = cut((5, 7), (2, 3))
    assert [tile.size for tile in tiles] == [6, 6, 2, 6, 6, 2, 3, 3, 1]
    np.testing.assert_array_equal(np.sort(np.concatenate(tiles)), np.arange(35))
    assert tiles[1].tolist() == [3, 4, 5, 10, 11, 12]


def test_what_cannot_be_joined_is_refused() -> None:
    matrix = sparse.csr_array(np.ones((2, 2)))
    silent = Problem(matrix, independent(0.0, 1.0, 2), np.zeros(2))
    recorded = np.ones(2)
    first, second = (alone(silent, recorded, np.array([pixel])) for pixel in (0, 1))
    with pytest.raises(InputError, match="with noise only"):
        merge(first, second, silent, recorded)
    with pytest.raises(InputError, match="do not overlap"):
        merge(first, first, silent, recorded)
    noisy = Problem(matrix, silent.prior, np.ones(2))
    with pytest.raises(InputError, match="dead pixels"):
        merge(first, second, noisy, np.array([1.0, np.nan]))
    with pytest.raises(InputError, match="independent pixels"):
        alone(Problem(matrix, exponential(0.0, 1.0, (1, 2), 1.0), np.ones(2)), recorded, np.array([0]))
    for wrong in ([], [0, 0], [2], [-1]):
        with pytest.raises(InputError, match="each once"):
            alone(noisy, recorded, np.array(wrong, dtype=np.intp))
    with pytest.raises(InputError, match="one tile or more"):
        sweep(noisy, recorded, [])
    with pytest.raises(InputError, match="double precision"):
        alone(Problem(matrix, independent(0.0, 1e308, 2), np.full(2, 1e-320)), recorded, np.array([0, 1]))
