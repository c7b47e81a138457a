"""Variances of nearly even noise from the shares of the measurements, beside one sweep over the whole frame."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.reconstruct.frame.variance_map import NearlyEven, interior_variance
from ommatid.reconstruct.frame.window_variances import (
    box_stencil,
    stencil_variances,
)
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera

from ..frames import P0, frame_camera, sliding

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
    return NearlyEven(camera, sliding(camera, means, 1 / P0))


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
