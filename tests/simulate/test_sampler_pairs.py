"""What a ray draws for the pupil does not depend on where in the pixel it begins."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from scipy import stats

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.renderer.variant import activate
from ommatid.simulate.sampling.samplers import fitting

from ..examples import needs

FAST = "llvm_ad_mono"
CELLS = 4  # along a side of a pixel and of the square that becomes the pupil
PIXELS, PASSES, SAMPLES = 256, 200, 16
SIGNIFICANCE = 1e-4


def cells(points: Any) -> Any:
    """Return the cell of each point of the unit square, (pixels, samples)."""
    index = np.minimum((np.array(points) * CELLS).astype(np.int64), CELLS - 1)
    return (index[0] * CELLS + index[1]).reshape(PIXELS, -1)


def shares(sampler: Sampler, reseeded: bool) -> FloatArray:
    """Return the share of samples in each pair of cells in every pass, (passes, 16, 16)."""
    activate(FAST)
    import drjit as dr
    import mitsuba as mi

    from ommatid.simulate.renderer.draws import ReseededSampler

    samples = fitting(sampler, SAMPLES)
    mitsuba: Any = mi.load_dict({"type": sampler, "sample_count": samples})
    mitsuba.set_samples_per_wavefront(samples)
    counts = np.empty((PASSES, CELLS**2 * CELLS**2))
    for number in range(PASSES):
        seed, lanes = sampler_seeds(0, "data", number, PASSES)(0), PIXELS * samples
        mitsuba.seed(seed, lanes)
        at = mitsuba.next_2d()
        pupil = (ReseededSampler(mitsuba, seed, lanes) if reseeded else mitsuba).next_2d()
        dr.eval(at, pupil)
        pairs = cells(at) * CELLS**2 + cells(pupil)
        counts[number] = np.bincount(pairs.ravel(), minlength=counts.shape[1])
    return counts / (PIXELS * samples)


def largest_score(counts: FloatArray) -> float:
    """Return the largest deviation of a cell's mean over passes from the same for all, in standard errors."""
    error = counts.std(axis=0, ddof=1) / PASSES**0.5
    return float(np.abs((counts.mean(axis=0) - 1 / counts.shape[1]) / error).max())


@pytest.mark.parametrize("sampler", get_args(Sampler))
def test_cells_of_the_pixel_and_of_the_pupil_meet_equally_often(sampler: Sampler) -> None:
    """A test of the largest of 256 Student's t."""
    needs(FAST)
    limit = stats.t.isf(SIGNIFICANCE / CELLS**4 / 2, PASSES - 1)
    assert largest_score(shares(sampler, reseeded=True)) < limit


@pytest.mark.parametrize("sampler", get_args(Sampler))
def test_errors_of_pixels_are_independent(sampler: Sampler) -> None:
    """The scatter of the mean over pixels is that of one pixel over the square root of their number.

    The readings are shares of rays behind an edge that moves with the pupil, as in front of a lens out of focus.
    """
    needs(FAST)
    activate(FAST)
    import mitsuba as mi

    from ommatid.simulate.renderer.draws import ReseededSampler

    samples = fitting(sampler, SAMPLES)
    mitsuba: Any = mi.load_dict({"type": sampler, "sample_count": samples})
    mitsuba.set_samples_per_wavefront(samples)
    readings = np.empty((PASSES, PIXELS))
    for number in range(PASSES):
        seed, lanes = sampler_seeds(0, "data", number, PASSES)(0), PIXELS * samples
        mitsuba.seed(seed, lanes)
        at = np.array(mitsuba.next_2d())
        pupil = np.array(ReseededSampler(mitsuba, seed, lanes).next_2d())
        readings[number] = (at[0] + 0.8 * pupil[0] < 0.9).reshape(PIXELS, samples).mean(axis=1)
    ratio = readings.mean(axis=1).var(ddof=1) * PIXELS / readings.var(axis=0, ddof=1).mean()
    low, high = (float(stats.chi2.ppf(p, PASSES - 1)) / (PASSES - 1) for p in (SIGNIFICANCE / 2, 1 - SIGNIFICANCE / 2))
    assert low < ratio < high
    bias = readings.mean() - 0.5
    assert abs(bias) < 4 * (readings.var(axis=0, ddof=1).mean() / readings.size) ** 0.5
