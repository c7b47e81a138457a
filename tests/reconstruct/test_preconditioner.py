"""The approximate inverse of a frame's precision: each of its parts against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from ommatid.reconstruct.frame.preconditioner import BoxMeans, Preconditioner, is_sliding, preconditioner_for
from ommatid.simulate.ideal import ideal_matrix

from ..examples import Lenses, camera
from ..frames import FITTED, P0, frame_camera, precision

SHAPES = [(61, 70), (59, 59), (64, 47)]


@pytest.mark.parametrize("width", [1, 2, 3, 5, 7])
def test_means_continued_with_opposite_sign_are_diagonal_under_the_sine_transform(width: int) -> None:
    means = BoxMeans(width, 0, 40, 40)
    waves = fft.idst(np.eye(40), 2, axis=0, norm="ortho")
    np.testing.assert_allclose(means.continued.toarray() @ waves, waves * means.transfer, atol=1e-13)


def test_the_gram_of_means_is_that_of_the_averages_themselves() -> None:
    means = BoxMeans(3, 2, 17, 19)
    averages = np.array([[1 / 3 if start <= i < start + 3 else 0.0 for i in range(19)] for start in range(2, 15)])
    np.testing.assert_allclose(means.gram.toarray(), averages.T @ averages, atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("noise", [1e-6, 1e-2, 10.0])
def test_it_is_nearly_the_inverse(shape: tuple[int, int], noise: float) -> None:
    """Symmetric, and with eigenvalues of P K just below 1, with and without pixels that some types do not see."""
    one = frame_camera(shape)
    prepared = preconditioner_for(one, (1 / noise,) * 3, 1 / P0)
    dense = precision(ideal_matrix(one), np.full(one.measurements, 1 / noise), 1 / P0)
    columns = np.random.default_rng(0).normal(size=(40, one.unknowns))
    inverse = np.array([prepared.solve(column.reshape(shape)).ravel() for column in columns])
    cross = inverse @ columns.T
    np.testing.assert_allclose(cross, cross.T, rtol=1e-9, atol=1e-9 * np.abs(cross).max())
    again = np.array([prepared.solve((dense @ column).reshape(shape)).ravel() for column in inverse])
    energy = np.einsum("ij,jk,ik->i", inverse, dense, inverse)
    assert np.einsum("ij,jk,ik->i", again, dense, inverse) == pytest.approx(energy, rel=0.03)
    assert (np.einsum("ij,jk,ik->i", again, dense, inverse) <= energy * (1 + 1e-7)).all()  # 1e-6 costs digits


def test_the_sine_transform_alone_bounds_the_precision() -> None:
    """K <= M: what is mirrored at the edges only adds information."""
    one = frame_camera((31, 34))
    prepared = preconditioner_for(one, (100.0,) * 3, 1 / P0)
    assert isinstance(prepared, Preconditioner)
    dense = precision(ideal_matrix(one), np.full(one.measurements, 100.0), 1 / P0)
    waves = np.kron(*(fft.idst(np.eye(size), 2, axis=0, norm="ortho") for size in (31, 34)))
    whole = waves @ (prepared.spectrum.ravel()[:, None] * waves.T)
    assert np.linalg.eigvalsh(whole - dense).min() > -1e-9


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (("1/3", [3, 3], [2, 2]), True),
        (("1/3", [2, 3], [2, 2]), False),
        (("2/7", [3, 3], [2, 2]), False),
        (("1", [1, 1], [9, 9]), True),
    ],
)
def test_which_types_slide(lens: Lenses, expected: bool) -> None:
    one = camera((19, 19), (lens,))  # type: ignore[arg-type]
    assert is_sliding(one.types[0]) == expected
    if not expected:
        with pytest.raises(ValueError, match="lens type 'A' does not see every box"):
            preconditioner_for(one, (1.0,), 1.0)


def test_fitted_types_slide() -> None:
    assert all(is_sliding(kind) for kind in frame_camera((64, 64), FITTED).types)
