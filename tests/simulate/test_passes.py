"""Passes: division of samples, running moments, and the rounding of float32."""

from __future__ import annotations

from math import isqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.simulate.sampling.passes import BATCHES, Tally, plan, rounding_variance


@given(st.integers(16, 10**6))
def test_samples_are_divided_into_equal_passes_that_a_grid_can_fill(samples: int) -> None:
    work = plan(samples)
    assert work.passes >= 16
    assert work.passes % BATCHES == 0
    assert samples <= work.total <= 1.5 * samples + 16
    side = isqrt(work.samples)
    assert work.samples % side == 0, "a side of the jittered grid"
    assert work.samples <= 4096 + 64, "float32 sums of more are wrong by over 4e-5"


def test_tally_agrees_with_numpy_even_far_from_zero() -> None:
    rng = np.random.default_rng(0)
    passes = 1e6 + rng.normal(size=(20, 3, 4))
    tally = Tally(3, 4)
    for values in passes:
        tally.add(values)
    np.testing.assert_allclose(tally.mean, passes.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(tally.variance, passes.var(axis=0, ddof=1) / 20, rtol=1e-6)


@pytest.mark.parametrize("samples", [16, 256, 4096])
def test_the_rounding_variance_bounds_that_of_float32_sums(samples: int) -> None:
    """Sums of equal float32 values one after the other, as in a film."""
    values = np.random.default_rng(1).uniform(1, 255, 200).astype(np.float32)
    total = np.zeros(200, np.float32)
    for _ in range(samples):
        total += values
    error = total / np.float32(samples) - values.astype(np.float64)
    assert np.sqrt(np.mean(error**2 / rounding_variance(values.astype(np.float64), samples))) < 1.5
