"""The approximate inverse of a frame's precision: each of its parts against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.reconstruct.frame.preconditioner import is_sliding, preconditioner_for
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses, camera
from ..frames import P0, frame_camera, precision


@pytest.mark.parametrize(
    ("shape", "noise"),
    [
        ((41, 37), 1e-2),
        ((36, 36), 10.0),
        *(pytest.param((61, 70), noise, marks=pytest.mark.slow) for noise in (1e-6, 1e-2, 10.0)),
        pytest.param((59, 59), 1e-2, marks=pytest.mark.slow),
    ],
)
def test_it_is_nearly_the_inverse(shape: tuple[int, int], noise: float) -> None:
    """Symmetric, and r^T P K P r is between 97 % and 100 % of r^T P r for random r, up to rounding.

    The rounding error is that of solving K, of condition P0 / noise, and of sums over the pixels.
    """
    rounding = max(1e-9, float(np.finfo(np.float64).eps) * P0 / noise)
    frame = frame_camera(shape)
    preconditioner = preconditioner_for(frame, (1 / noise,) * 3, 1 / P0)
    dense = precision(ideal_matrix(frame), np.full(frame.measurements, 1 / noise), 1 / P0)
    columns = np.random.default_rng(0).normal(size=(40, frame.unknowns))
    inverse = np.array([preconditioner.solve(column.reshape(shape)).ravel() for column in columns])
    cross = inverse @ columns.T
    np.testing.assert_allclose(cross, cross.T, rtol=0, atol=rounding * np.abs(cross).max())
    again = np.array([preconditioner.solve((dense @ column).reshape(shape)).ravel() for column in inverse])
    energy = np.einsum("ij,jk,ik->i", inverse, dense, inverse)
    energy_again = np.einsum("ij,jk,ik->i", again, dense, inverse)
    assert (energy_again >= 0.97 * energy).all()
    assert (energy_again <= energy * (1 + rounding)).all()


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
    frame = camera((19, 19), (lens,))  # type: ignore[arg-type]
    assert is_sliding(frame.types[0]) == expected
    if not expected:
        with pytest.raises(ValueError, match="lens type 'A' does not see every box"):
            preconditioner_for(frame, (1.0,), 1.0)
