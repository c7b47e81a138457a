"""The approximate inverse of a frame's precision: each of its parts against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from ommatid.reconstruct.frame.preconditioner import BoxMeans, is_sliding, preconditioner_for
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses, camera
from ..frames import FITTED, P0, frame_camera, precision


@pytest.mark.parametrize("width", [1, 2, 3, 5, 7])
def test_antisymmetrically_continued_means_are_diagonal_under_the_sine_transform(width: int) -> None:
    means = BoxMeans(width, 0, 40, 40)
    waves = fft.idst(np.eye(40), 2, axis=0, norm="ortho")
    np.testing.assert_allclose(means.mirrored_gram.toarray() @ waves, waves * means.transfer, atol=1e-13)


def test_the_gram_matrix_is_that_of_the_averages() -> None:
    means = BoxMeans(3, 2, 17, 19)
    averages = np.array([[1 / 3 if start <= i < start + 3 else 0.0 for i in range(19)] for start in range(2, 15)])
    np.testing.assert_allclose(means.gram.toarray(), averages.T @ averages, atol=1e-15)


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


def test_the_sine_transform_alone_bounds_the_precision() -> None:
    """K <= M: the terms mirrored at the edges only add information."""
    frame = frame_camera((31, 34))
    preconditioner = preconditioner_for(frame, (100.0,) * 3, 1 / P0)
    dense = precision(ideal_matrix(frame), np.full(frame.measurements, 100.0), 1 / P0)
    waves = np.kron(*(fft.idst(np.eye(size), 2, axis=0, norm="ortho") for size in (31, 34)))
    mirrored = waves @ (preconditioner.spectrum.ravel()[:, None] * waves.T)
    assert np.linalg.eigvalsh(mirrored - dense).min() > -1e-9


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


def test_fitted_lens_types_are_shift_invariant() -> None:
    assert all(is_sliding(lens_type) for lens_type in frame_camera((64, 64), FITTED).types)
