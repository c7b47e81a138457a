"""The ideal H against brute force, closed forms and the paper's ranks."""

from __future__ import annotations

from fractions import Fraction
from math import ceil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.boxes import overlap
from ommatid.simulate.ideal import ideal_matrix

from ..examples import camera


def by_supersampling(one: Camera, fine: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return H by counting points of a fine grid, in the cells of a common denominator."""
    rows: list[np.ndarray[tuple[int], np.dtype[np.float64]]] = []
    for sub in one.sub_imagers:
        m = float(sub.type.ratio)
        offsets = (np.arange(fine) + 0.5) / fine * m
        for i in range(sub.type.pixels[0]):
            for j in range(sub.type.pixels[1]):
                down = np.floor(float(sub.window[0]) + m * i + offsets).astype(int)
                across = np.floor(float(sub.window[1]) + m * j + offsets).astype(int)
                row = np.zeros(one.shape)
                np.add.at(row, (down[:, None], across[None, :]), 1 / fine**2)
                rows.append(row.ravel())
    return np.array(rows)


@pytest.mark.parametrize(
    ("shape", "lenses", "fine"),
    [
        ((19, 19), (("1/3", [3, 3], [5, 5]),), 3),
        ((13, 17), (("1/4", [2, 3], [2, 3]), ("1/5", [1, 2], [2, 3])), 20),
        ((12, 12), (("2/5", [2, 2], [3, 4]),), 5),
        ((11, 12), (("3/10", [2, 1], [2, 3]),), 10),
    ],
)
def test_against_counting_points(
    shape: tuple[int, int], lenses: tuple[tuple[str, list[int], list[int]], ...], fine: int
) -> None:
    one = camera(shape, lenses)
    np.testing.assert_allclose(ideal_matrix(one).toarray(), by_supersampling(one, fine), atol=1e-12)


@given(
    st.fractions(min_value=Fraction(1), max_value=Fraction(9), max_denominator=50),
    st.integers(1, 6),
    st.fractions(min_value=Fraction(0), max_value=Fraction(3), max_denominator=40),
)
@settings(max_examples=200)
def test_overlaps_are_shares(ratio: Fraction, pixels: int, start: Fraction) -> None:
    size = int(start + ratio * pixels) + 1
    shares = overlap(ratio, pixels, start, size).toarray()
    assert (shares >= 0).all()
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-14)
    covered = shares.sum(axis=0) * float(ratio)
    inside = slice(ceil(start), int(start + ratio * pixels))
    np.testing.assert_allclose(covered[inside], 1, rtol=1e-12)


@pytest.mark.parametrize("m", [2, 3, 4, 5])
def test_null_space_of_one_type(m: int) -> None:
    """One type of m shifts leaves a = m - 1 unseen combinations along an axis: 2 a N - a^2 in the plane."""
    size = m * 4 + m - 1
    one = camera((size, size), ((f"1/{m}", [m, m], [4, 4]),))
    rank = np.linalg.matrix_rank(ideal_matrix(one).toarray(), tol=1e-9)
    a = m - 1
    assert size**2 - rank == 2 * a * size - a**2


def test_null_space_of_two_coprime_types_and_of_three() -> None:
    """Two coprime types leave 2 a b, three leave nothing, where all of them see the whole target (29 = 30 - 1)."""
    one = camera((29, 29), (("1/2", [2, 2], [14, 14]), ("1/3", [3, 3], [9, 9]), ("1/5", [5, 5], [5, 5])))
    dense = ideal_matrix(one).toarray()
    two = dense[one.types[0].measurements :]
    assert 29**2 - np.linalg.matrix_rank(two, tol=1e-9) == 2 * (3 - 1) * (5 - 1)
    assert np.linalg.matrix_rank(dense, tol=1e-9) == 29**2
