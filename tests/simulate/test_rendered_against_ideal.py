"""Renderings in Mitsuba against the closed form, pixel by pixel, to the statistical limit.

The variance of each pixel's mean comes from its 16 passes alone, so Student's t with 15 degrees of freedom applies,
corrected for the number of pixels (Sidak); where all passes agree, float32's rounding is the limit.
"""

from __future__ import annotations

from math import log
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from ommatid.scenes.camera import derive
from ommatid.scenes.scene import parse
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.calibration.responses import measured
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import light
from ommatid.simulate.sampling.passes import rounding_variance
from ommatid.simulate.sampling.samplers import fitting

from ..examples import SLOW_SCALAR, THREE, VARIANTS, assert_student, familywise, needs, scene, with_optics
from .strata import corners
from .world_files import LETTER, assert_rendered

UNUSUAL = (("2/5", [2, 2], [4, 3]), ("3/10", [1, 2], [2, 3]), (1, [1, 1], [9, 8]))
CUT = slice(450)  # pixels of three_types whose strata are cut by edges of pixels of f: those of 1/4 are not


def three_types(variant: str, samples: int, sampler: str = "multijitter", seed: int = 11) -> Setup:
    """Return a tile with three lens types, rendered and calibrated with these samples per pixel."""
    render = {"variant": variant, "samples": samples, "sampler": sampler, "seed": seed}
    return Setup.from_scene(scene((19, 19), THREE, render=render, calibration={"samples": samples}))


def ideal(setup: Setup) -> NDArray[np.float64]:
    """Return the light of the setup's image in closed form, (M,)."""
    return ideal_matrix(setup.camera) @ setup.image.ravel()


def effective_number(variance: NDArray[np.float64]) -> float:
    """Return the effective number of terms in a sum of squares of unequal variances, (sum v)^2 / sum v^2.

    variance : from 16 passes, whose squares are 1 + 2/15 times too large on average
    """
    return float(variance.sum() ** 2 / (np.square(variance).sum() / (1 + 2 / 15)))


def assert_readings(setup: Setup, sampler: Sampler, samples: int) -> None:
    """Assert that rendered readings are those of the closed form."""
    rendering = assert_rendered(setup)
    assert rendering.passes == 16
    assert rendering.record["samples"] == 16 * fitting(sampler, samples // 16)


@pytest.mark.parametrize("sampler", get_args(Sampler))
@pytest.mark.parametrize("variant", VARIANTS)
def test_sub_images_of_a_photograph(variant: str, sampler: Sampler) -> None:
    needs(variant)
    samples = 4096 if sampler in ("multijitter", "independent") else 1024
    assert_readings(three_types(variant, samples, sampler), sampler, samples)


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_fractional_ratios(variant: str) -> None:
    """Footprints whose edges cut through pixels of the target, arrays that are not square, and magnification 1."""
    needs(variant)
    render = {"variant": variant, "samples": 16384, "seed": 5}
    assert_readings(Setup.from_scene(scene((13, 15), UNUSUAL, render=render)), "multijitter", 16384)


def assert_entries(setup: Setup, least: float = 0.0) -> None:
    """Assert that H by points is the closed form.

    least : of an entry; slivers that less than one ray in a hundred passes hits are not normally distributed
    """
    responses = measured(setup, by_points=True)
    matrix, exact = responses.matrix, ideal_matrix(setup.camera).toarray()
    dense = matrix.toarray()
    assert (dense[exact > least] > 0).all(), "every entry of the closed form is seen"
    others = np.abs(dense - exact)[exact <= least].sum()
    assert others < (1e-4 if least else 1e-5) * dense.sum(), "no other is, except by rays rounded over an edge"
    rows = np.repeat(np.arange(setup.camera.measurements), np.diff(matrix.indptr))
    thick = exact[rows, matrix.indices] > least if least else np.full(matrix.nnz, True)
    variance = np.maximum(responses.variance, rounding_variance(matrix.data, responses.work.samples))
    assert_student((matrix.data - exact[rows, matrix.indices])[thick], variance[thick], responses.work.passes)
    np.testing.assert_allclose(dense.sum(axis=1), 1, atol=1e-4)


@pytest.mark.parametrize(
    ("variant", "samples"),
    [("llvm_ad_mono", 1024), *(pytest.param(each, 4096, marks=pytest.mark.slow) for each in VARIANTS)],
)
def test_calibrated_h(variant: str, samples: int) -> None:
    needs(variant)
    assert_entries(three_types(variant, samples))


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_calibrated_h_of_fractional_ratios(variant: str) -> None:
    """Footprints cut through pixels of f; the edges of one type almost coincide with theirs, to float32's rounding."""
    needs(variant)
    lenses = (("2/7", [2, 2], [3, 2]), ("333333/1000000", [2, 2], [3, 4]), ("1/3", [1, 1], [4, 4]))
    data = scene((13, 14), lenses, render={"variant": variant, "seed": 2}, calibration={"samples": 4096}).plain()
    data["camera"]["lens"][0]["step"] = "1/3"
    assert_entries(Setup.from_scene(parse(data, Path("test.toml"))), 1e-3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_letter_f_is_upright(variant: str) -> None:
    """A lens of magnification 1 records the picture itself; its neighbours see it shifted to the left and up."""
    needs(variant)
    letter = LETTER * 200.0
    described = scene((12, 12), ((1, [2, 2], [9, 9]),), render={"variant": variant, "samples": 16})
    camera = derive(described)
    assert camera.types[0].origin == (1, 1)
    rendering = light(Setup(described, camera, letter))
    pictures = [rendering.mean[rows].reshape(9, 9) for rows in camera.slices()]
    for sub, picture in zip(camera.sub_imagers, pictures, strict=True):
        window = letter[1 + sub.k : 10 + sub.k, 1 + sub.l : 10 + sub.l]
        np.testing.assert_allclose(picture, window, atol=1e-3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_uniform_target_reads_its_own_value(variant: str) -> None:
    """To the rounding of a float32 film; a pinhole at a finite distance does not darken towards the edge."""
    needs(variant)
    setup = three_types(variant, 256)
    rendering = light(Setup(setup.scene, setup.camera, np.full((19, 19), 100.0)))
    np.testing.assert_allclose(rendering.mean, 100.0, rtol=2e-6)


@pytest.mark.parametrize(("sampler", "power"), [("independent", 0.5), ("multijitter", 0.75)])
@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_the_error_falls_by_the_law_of_the_sampler(variant: str, sampler: str, power: float) -> None:
    """n^-1/2 for independent samples; n^-3/4 for stratified ones and edges, up to the bound of `corners`.

    The logarithm of a root mean square over n pixels has the variance 1 / (2 n).
    """
    needs(variant)
    logarithms: list[float] = []
    variance = 0.0
    for samples in (256, 4096):
        setup = three_types(variant, samples, sampler)
        rendering = light(setup)
        errors = (rendering.mean - ideal(setup))[CUT]
        logarithms.append(0.5 * log(np.mean(errors**2)))
        variance += 0.5 / effective_number(rendering.variance[CUT])
    slope = (logarithms[1] - logarithms[0]) / log(16)
    limit = float(stats.norm.isf(familywise(4) / 2)) * variance**0.5 / log(16)
    systematic = 0.0 if sampler == "independent" else corners(derive(scene((19, 19), THREE)), 16, 256)
    assert abs(slope + power) < limit + systematic


@pytest.mark.parametrize("sampler", ["multijitter", "independent"])
@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_the_stated_variance_is_the_mean_squared_error(variant: str, sampler: str) -> None:
    """The ratio of both, over n pixels, has the variance 2 / n (1 + 1/15): of the errors, and of 16 passes."""
    needs(variant)
    setup = three_types(variant, 1024, sampler)
    rendering = light(setup)
    errors, variance = (rendering.mean - ideal(setup))[CUT], rendering.variance[CUT]
    deviation = (2 / effective_number(variance) * (1 + 1 / 15)) ** 0.5
    limit = float(stats.norm.isf(familywise(4) / 2)) * deviation
    assert np.sum(errors**2) / np.sum(variance) == pytest.approx(1, abs=limit)


@pytest.mark.parametrize("variant", VARIANTS)
def test_errors_of_data_calibration_and_seeds_are_uncorrelated(variant: str) -> None:
    needs(variant)
    setup, other = three_types(variant, 64), three_types(variant, 64, seed=12)
    exact = ideal(setup)[CUT]
    calibrated = measured(setup, by_points=True).matrix @ setup.image.ravel()
    every = light(setup).mean, light(other).mean, calibrated
    errors = np.array([(values[CUT] - exact) / np.sqrt(exact + 1) for values in every])
    correlations = np.corrcoef(errors)[np.triu_indices(3, 1)]
    assert np.abs(correlations).max() < stats.norm.isf(familywise(6) / 2) / exact.size**0.5


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_no_ray_is_assigned_to_another_sub_imager(variant: str) -> None:
    """Film coordinates are float32 and round up to the next pixel's once in some hundred thousand rays.

    Each of 256 sub-imagers looks into a block of one value, with a rim around its window: a ray from another block
    would be visible against the rounding of 256 equal values.
    """
    needs(variant)
    render = {"variant": variant, "samples": 4096}
    described, camera = with_optics({"step": 6}, {}, ((1, [16, 16], [4, 4]),), (98, 98), render=render)
    assert camera.types[0].origin == (2, 2)
    blocks = np.random.default_rng(0).uniform(50.0, 250.0, (16, 16)).astype(np.float32).astype(np.float64)
    image = np.pad(np.kron(blocks, np.ones((6, 6))), 1, mode="edge").astype(np.float64)
    rendering = light(Setup(described, camera, image))
    np.testing.assert_allclose(
        rendering.mean.reshape(256, 16), np.repeat(blocks.reshape(256, 1), 16, axis=1), rtol=1e-5
    )
