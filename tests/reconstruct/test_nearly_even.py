"""Variances of nearly even noise from the shares of the measurements, beside one sweep over the whole frame."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from ommatid.reconstruct.frame.preconditioner import preconditioner_for
from ommatid.reconstruct.frame.variance_map import LARGEST_GAP, NearlyEven, interior_variance
from ommatid.reconstruct.frame.window_variances import (
    EvenNoise,
    box_stencil,
    even_couplings,
    frame_variances,
    stencil_variances,
)
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera

from ..frames import P0, frame_camera

SHAPE = (101, 97)
FAR = (slice(28, -28), slice(28, -28))
EDGES = 1e-4  # relative effect of the edges on the variance of pixels that far from them


def uneven(camera: Camera, more: float, share: float) -> FloatArray:
    """Weights of noise that is larger, by up to `more`, for a random share of the measurements."""
    rng = np.random.default_rng(0)
    larger = rng.uniform(size=camera.measurements) < share
    return 100 / (1 + more * larger * rng.uniform(size=camera.measurements))


def nearly_even(camera: Camera, weights: FloatArray) -> NearlyEven:
    means = tuple(float(weights[part].mean()) for part in camera.type_slices())
    return NearlyEven(camera, preconditioner_for(camera, means, 1 / P0))


@pytest.mark.parametrize(
    ("more", "share"),
    [(0.3, 0.02), pytest.param(0.05, 1.0, marks=pytest.mark.slow), pytest.param(1.0, 0.5, marks=pytest.mark.slow)],
)
def test_the_variance_lies_within_the_gap_of_one_sweep(more: float, share: float) -> None:
    camera = frame_camera(SHAPE)
    weights = uneven(camera, more, share)
    exact = stencil_variances(box_stencil(camera, weights, 1 / P0, slice(0, SHAPE[0]), slice(0, SHAPE[1])))
    interior = nearly_even(camera, weights)
    error = np.abs(interior.variances(weights) / exact - 1)[FAR]
    even = np.abs(interior_variance(interior.system) / exact - 1)[FAR]
    assert (error <= interior.gap(weights)[FAR] + EDGES).all()
    assert even.max() > 2 * error.max()  # the map of even noise misses most of it


@pytest.mark.slow
def test_one_noisier_measurement_raises_the_variance_by_its_share() -> None:
    """The derivative by one weight, by a difference of two sweeps of the whole frame."""
    camera = frame_camera(SHAPE)
    even, step = np.full(camera.measurements, 100.0), 1e-3
    part = camera.type_slices()[1]
    changed = even.copy()
    changed[part.start + (part.stop - part.start) // 2] *= 1 - step
    whole = slice(0, SHAPE[0]), slice(0, SHAPE[1])
    before, after = (stencil_variances(box_stencil(camera, weights, 1 / P0, *whole)) for weights in (even, changed))
    interior = NearlyEven(camera, preconditioner_for(camera, (100.0,) * 3, 1 / P0))
    exact = (after / before - 1)[FAR] / step
    computed = (interior.variances(changed) / interior_variance(interior.system) - 1)[FAR] / step
    assert exact.max() > 0.01
    np.testing.assert_allclose(computed, exact, atol=0.01 * exact.max())


@pytest.mark.slow
def test_only_windows_with_uneven_noise_are_computed() -> None:
    """A frame whose noise is uneven in one corner region, beside one sweep: no other window is needed."""
    camera = frame_camera((131, 127))
    weights = uneven(camera, 0.02, 1.0)
    seen = camera.type_slices()[0]
    weights[seen.start + (seen.stop - seen.start) // 2] /= 5
    source = partial(box_stencil, camera, weights, 1 / P0)
    exact = stencil_variances(source(slice(0, 131), slice(0, 127)))
    interior = nearly_even(camera, weights)
    needed = interior.gap(weights) > LARGEST_GAP
    assert 0 < needed.mean() < 0.2
    means = interior.system.weights
    even = EvenNoise(even_couplings([3, 5, 4], means, 1 / P0, 4), interior_variance(interior.system))
    known = np.where(needed, np.nan, interior.variances(weights))
    variance = frame_variances(source, (131, 127), 20, even, known)
    np.testing.assert_allclose(variance, exact, rtol=LARGEST_GAP)
