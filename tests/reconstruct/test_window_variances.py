"""Variances of frames with uneven noise: windows beside whole frames, and the check by solutions."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy import linalg

from ommatid.reconstruct.frame.conjugate_gradients import FrameSystem
from ommatid.reconstruct.frame.error_map import ExactVariances, check_map
from ommatid.reconstruct.frame.variance_map import interior_variance
from ommatid.reconstruct.frame.window_variances import (
    EvenNoise,
    box_stencil,
    even_couplings,
    frame_variances,
    stencil_variances,
)
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.simulate.ideal import ideal_matrix

from ..frames import P0, frame_camera, observed, precision, sliding

SMALL = (47, 41)
WIDE = (79, 73)


def uneven(camera: Camera, decades: float, by_type: tuple[float, ...] = (1.0, 1.0, 1.0)) -> FloatArray:
    """Noise variances from 1e-2 on, over some decades, of types that differ by a factor."""
    factors = np.repeat(by_type, [lens_type.measurements for lens_type in camera.types])
    return 1e-2 * factors * 10 ** np.random.default_rng(0).uniform(0, decades, camera.measurements)


@pytest.mark.parametrize(
    ("decades", "by_type", "pixel", "mean"),
    [
        pytest.param(3.0, (1, 1, 1), 2e-2, 2e-3, marks=pytest.mark.slow),
        (1.0, (1, 4, 2), 2e-2, 2e-3),
    ],
)
def test_windows_are_the_whole_frame_to_the_stated_accuracy(
    decades: float, by_type: tuple[float, ...], pixel: float, mean: float
) -> None:
    """Short halos, against one sweep over the frame without any: 2 % a pixel and 0.2 % in the mean."""
    camera = frame_camera(WIDE)
    weights = 1 / uneven(camera, decades, by_type)
    source = partial(box_stencil, camera, weights, 1 / P0)
    exact = stencil_variances(source(slice(0, WIDE[0]), slice(0, WIDE[1])))
    means = tuple(float(weights[part].mean()) for part in camera.type_slices())
    even = EvenNoise(even_couplings([3, 5, 4], means, 1 / P0, 4), interior_variance(sliding(camera, means, 1 / P0)))
    variance = frame_variances(source, WIDE, 15, even)
    np.testing.assert_allclose(variance, exact, rtol=pixel)
    assert variance.mean() == pytest.approx(exact.mean(), rel=mean)


@pytest.mark.parametrize("as_expected", [pytest.param(True, marks=pytest.mark.slow), False])
def test_one_solution_measures_the_variances_of_distant_pixels(as_expected: bool) -> None:
    """Against the dense Eq. 5 where one pixel fits into the frame, and a map that is 5 % off is found."""
    camera = frame_camera(SMALL)
    expected = uneven(camera, 1)
    actual = expected if as_expected else expected[::-1].copy()
    weights = 1 / expected
    matrix = ideal_matrix(camera)
    covariance = linalg.inv(precision(matrix, weights, 1 / P0))
    gain = covariance @ (matrix.T.toarray() * weights)
    error = np.square(covariance).sum(axis=1) / P0 + np.square(gain) @ actual
    system = FrameSystem(observed(camera), weights, 1 / P0)
    exact = ExactVariances(system, None if as_expected else weights**2 * actual, 0.01)
    posterior = np.ascontiguousarray(np.diagonal(covariance))
    assert check_map(error, posterior, SMALL, exact, local=True).worst < 2e-3
    wrong = check_map(1.05 * error, posterior, SMALL, exact, local=True)
    assert wrong.worst == pytest.approx(0.05, abs=3e-3)
    assert wrong.mean == pytest.approx(0.05, abs=3e-3)
