"""Averages over boxes against the stored matrix, which tests/simulate/test_ideal.py compares with counted points."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.scenes.model import Model
from ommatid.simulate.ideal import ideal_matrix

from ..examples import THREE, Lenses, camera, scene
from ..frames import observed

CAMERAS: list[tuple[tuple[int, int], Lenses]] = [
    ((19, 19), THREE),
    ((70, 61), tuple((magnification, array, "fit") for magnification, array, _ in THREE)),
    ((13, 17), (("1/4", [2, 3], [2, 3]), ("1/5", [1, 2], [2, 3]))),
    ((12, 12), (("2/5", [2, 2], [3, 4]),)),
    ((11, 12), (("3/10", [2, 1], [2, 3]),)),
    ((7, 5), (("1", [1, 1], [7, 5]),)),
]


@pytest.mark.parametrize(("shape", "lenses"), CAMERAS)
def test_against_the_stored_matrix(shape: tuple[int, int], lenses: Lenses) -> None:
    cam = camera(shape, lenses)
    matrix, applied, rng = ideal_matrix(cam), observed(cam), np.random.default_rng(0)
    image, readings = rng.normal(size=cam.unknowns), rng.normal(size=cam.measurements)
    np.testing.assert_allclose(applied.forward(image), matrix @ image, atol=1e-14)
    np.testing.assert_allclose(applied.adjoint(readings), matrix.T @ readings, atol=1e-13)
    assert applied.entries == matrix.nnz
    assert abs(applied.to_sparse() - matrix).max() < 1e-15


@pytest.mark.parametrize(("shape", "lenses"), CAMERAS[1:3])
@pytest.mark.parametrize("corner", [(0, 0), (2, 3), (4, 5)])
def test_windows_have_the_measurements_inside_them(
    shape: tuple[int, int], lenses: Lenses, corner: tuple[int, int]
) -> None:
    cam = camera(shape, lenses)
    rows, columns = (slice(start, start + min(size - start, 30) - 1) for start, size in zip(corner, shape, strict=True))
    dense = ideal_matrix(cam).toarray().reshape(-1, *shape)
    outside = dense.copy()
    outside[:, rows, columns] = 0
    expected = np.flatnonzero(~outside.any(axis=(1, 2)))
    whole = ideal_matrix(cam)
    stored = Model(scene(), cam, whole, np.zeros(whole.nnz), np.zeros((0, whole.nnz), np.float32), {"method": "points"})
    for h in (observed(cam), stored.observation):
        inside = h.measurements_inside(rows, columns)
        np.testing.assert_array_equal(np.sort(inside), expected)
        np.testing.assert_allclose(
            h.submatrix(rows, columns).toarray(),
            dense[inside][:, rows, columns].reshape(inside.size, -1),
            atol=1e-15,
        )


def test_windows_of_one_signature_have_the_same_h() -> None:
    cam = observed(camera((70, 61), CAMERAS[1][1]))
    first, second, edge = (slice(10, 40), slice(12, 42)), (slice(11, 41), slice(19, 49)), (slice(0, 30), slice(12, 42))
    assert cam.signature(*first) == cam.signature(*second)
    assert (cam.submatrix(*first) - cam.submatrix(*second)).nnz == 0
    assert cam.signature(*first) != cam.signature(*edge)


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (("1/3", [3, 3], [2, 2]), True),
        (("1/3", [2, 3], [2, 2]), False),
        (("2/7", [3, 3], [2, 2]), False),
        (("1", [1, 1], [9, 9]), True),
    ],
)
def test_which_lens_types_are_shift_invariant(lens: Lenses, expected: bool) -> None:
    assert camera((19, 19), (lens,)).is_sliding == expected  # type: ignore[arg-type]
