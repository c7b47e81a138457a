"""Mitsuba's samplers and passes: numbers of samples, independent streams of pixels and pupils, moments, laws."""

from __future__ import annotations

from math import isqrt
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from ommatid.bench.slopes import law
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.picture import load
from ommatid.scenes.optics.boxes import overlap
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import activate
from ommatid.simulate.sampling.passes import BATCHES, JITTERED, Tally, on_grid, plan, rounding_variance
from ommatid.simulate.sampling.samplers import SOBOL, filling, fitting

from ..examples import SLOW_SCALAR, THREE, VARIANTS, camera, familywise, needs, scene
from .strata import corners

SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)


@pytest.mark.parametrize("variant", VARIANTS)
def test_mitsuba_accepts_the_numbers_of_samples_unchanged(variant: str) -> None:
    needs(variant)
    activate(variant)
    import mitsuba as mi

    for sampler in SAMPLERS:
        mitsuba: Any = mi.load_dict({"type": sampler, "sample_count": fitting(sampler, 1)})
        for asked in (1, 2, 3, 4, 5, 7, 16, 17, 60, 64, 100, 200, 256, 1000, 1024, 4096, 16384):
            count = fitting(sampler, asked)
            mitsuba.set_sample_count(count)
            assert mitsuba.sample_count() == count >= asked


@given(st.sampled_from((*SAMPLERS, SOBOL)), st.integers(1, 2**20), st.sampled_from((1, 2, 3, 5, 7, 16)), st.booleans())
def test_samples_are_divided_into_equal_passes_that_fill_a_grid(
    sampler: Any, samples: int, cells: int, fits_pixels: bool
) -> None:
    """Of the sampler, or of a multiple of `cells` a side where it puts one sample into each cell."""
    count = fitting(sampler, samples)
    assert samples <= count <= 4 * samples + 4
    assert fitting(sampler, count) == count
    assert fitting(sampler, filling(sampler, min(samples, 20_000))) <= max(samples, fitting(sampler, 1))
    work = on_grid(samples, sampler, cells) if fits_pixels else plan(samples, sampler)
    assert work.passes >= 16
    assert work.passes % BATCHES == 0
    assert work.total >= samples
    assert work.samples <= (4096 if fits_pixels else 4 * 4096), "float32 sums of more are wrong by over 4e-5"
    if fits_pixels and sampler in JITTERED:
        assert isqrt(work.samples) ** 2 == work.samples
        assert isqrt(work.samples) % cells == 0
    else:
        assert fitting(sampler, work.samples) == work.samples
    if sampler == "multijitter" and not fits_pixels:
        assert work.total <= 1.5 * samples + 16
        assert work.samples <= 4096 + 64


def errors(
    variant: str, sampler: Sampler, samples: int, repeats: int, image: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return errors of single passes with different seeds, (repeats, pixels), of lens types whose edges cut strata."""
    seen = camera()
    renderer = Renderer(seen, variant, sampler)
    renderer.set_target(image)
    values = np.empty((repeats, seen.measurements))
    for number in range(repeats):
        seeds = [sampler_seeds(5, "data", number, repeats)]
        for group in renderer.groups:
            values[number, renderer.rows(group)] = renderer.expose(renderer.pixels(group), samples, seeds)[0, 0]
    return (values - ideal_matrix(seen) @ image.ravel())[:, :450]


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_pixels_and_passes_have_independent_streams(variant: str, sampler: Sampler) -> None:
    """The sum over pixels of one seed scatters as that of independent ones; consecutive seeds have little in common.

    The significance is that of all samplers and variants together: scalar ldsampler's sum is beyond 0.001 of one alone,
    as one start in some thousand is. Over 160 others the mean square is 0.999 +- 0.010, and scatters as chi-squared.
    Mitsuba hashes seeds shallowly: ldsampler's neighbours on llvm correlate by -0.013 (measured over 2000). Below 0.03
    the variance of a mean of 16 passes is within 6 % of what their scatter says.
    """
    needs(variant)
    repeats = 128
    found = errors(variant, sampler, 16, repeats, load(scene((19, 19), THREE)))
    found = found[:, found.std(axis=0) > 1e-3]
    scores = found / np.sqrt(np.mean(found**2, axis=0))
    over_pixels = float(np.sum(scores.sum(axis=1) ** 2) / scores.shape[1])
    tail = familywise(len(SAMPLERS) * len(VARIANTS)) / 2
    assert stats.chi2.ppf(tail, repeats) < over_pixels < stats.chi2.isf(tail, repeats)
    assert abs(np.mean(scores[1:] * scores[:-1])) < 0.03, "known to 0.004"


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_neighbours_err_independently_in_a_mean_over_passes(variant: str, sampler: Sampler) -> None:
    """No pixel has the stream that its neighbour had in another pass: seen where each shows the same 3 x 3 pixels of f.

    Mitsuba numbers streams by seed plus samples times pixel. Seeds 4 apart made neighbours' means over 16 passes of 16
    samples correlate by 0.74 with ldsampler.
    """
    needs(variant)
    pattern = np.tile(np.add.outer((0.0, 20.0, 90.0), (0.0, 50.0, 120.0)) % 100, (7, 7))[:19, :19]
    passes, means, views = 16, 8, 9
    found = errors(variant, sampler, 16, passes * means, pattern)[:, : views * 25]
    mean = found.reshape(means, passes, views, 5, 5).mean(axis=1)
    mean /= np.sqrt(np.mean(mean**2))
    products = mean[..., 1:] * mean[..., :-1]
    assert abs(np.mean(products)) < 5 / products.size**0.5


def jittered(described: Scene, seen: Camera, side: int) -> NDArray[np.float64]:
    """Return the exact variance of each pixel's mean over side x side jittered strata, (M,): sum of theirs / n^2."""
    image = load(described)
    found: list[NDArray[np.float64]] = []
    for sub in seen.sub_imagers:
        means = [
            overlap(sub.type.ratio / side, count * side, start, size).toarray()
            for count, start, size in zip(sub.type.pixels, sub.window, image.shape, strict=True)
        ]
        inside = means[0] @ image**2 @ means[1].T - (means[0] @ image @ means[1].T) ** 2
        rows, columns = sub.type.pixels
        found.append(inside.reshape(rows, side, columns, side).sum(axis=(1, 3)).ravel() / side**4)
    return np.concatenate(found)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_error_of_stratified_samples_is_that_of_the_strata(variant: str) -> None:
    """Exactly, pixel by pixel; for many strata it falls by the n^-3/4 of `law`."""
    needs(variant)
    described, seen = scene((19, 19), THREE), camera()
    expected = jittered(described, seen, 4)[:450]
    repeats = 64
    ratio = np.mean(np.square(errors(variant, "stratified", 16, repeats, load(described))).mean(axis=0) / expected)
    assert ratio == pytest.approx(1, abs=4 * (2 / repeats / 450) ** 0.5), "of squares of sums"
    sizes = [float(np.sqrt(np.mean(jittered(described, seen, side)))) for side in (8, 32)]
    told = law("stratified", seen)
    assert told.slope == pytest.approx(np.log(sizes[1] / sizes[0]) / np.log(16), abs=0.01)
    for first, last in ((8, 16), (8, 32), (16, 64)):
        ends = [float(np.sqrt(np.mean(jittered(described, seen, side)))) for side in (first, last)]
        away = abs(np.log(ends[1] / ends[0]) / np.log((last / first) ** 2) + 0.75)
        assert away <= corners(seen, first**2, last**2) < 0.06
    assert law("independent", seen).slope == -0.5
    assert law("ldsampler", seen).slope is None


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
