"""What Mitsuba renders against the closed form, pixel by pixel, to the statistical limit.

The variance of each pixel's mean comes from its 16 passes alone, so Student's t with 15 degrees of freedom applies,
corrected for the number of pixels (Sidak); where all passes agree, float32's rounding is the limit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.point_sources import responses_from_points
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import Rendering, light
from ommatid.simulate.sampling.passes import rounding_variance

from ..examples import THREE, VARIANTS, assert_student, needs, scene

UNUSUAL = (("2/5", [2, 2], [4, 3]), ("3/10", [1, 2], [2, 3]), (1, [1, 1], [9, 8]))


def three_types(variant: str, samples: int, sampler: str = "multijitter", seed: int = 11) -> tuple[Scene, Camera]:
    render = {"variant": variant, "samples": samples, "sampler": sampler, "seed": seed}
    described = scene((19, 19), THREE, render=render, calibration={"samples": samples})
    return described, derive(described)


def floored(rendering: Rendering) -> NDArray[np.float64]:
    return np.maximum(rendering.variance, rounding_variance(rendering.mean, rendering.samples))


@pytest.mark.parametrize("sampler", ["multijitter", "independent"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_sub_images_of_a_photograph(variant: str, sampler: str) -> None:
    needs(variant)
    described, camera = three_types(variant, 4096, sampler)
    image = load(described)
    rendering = light(Setup(described, camera, image))
    difference = rendering.mean - ideal_matrix(camera) @ image.ravel()
    assert {sub.type.name for sub in camera.sub_imagers} == {"A", "B", "C"}
    assert_student(difference, floored(rendering), rendering.passes)


@pytest.mark.parametrize("variant", VARIANTS)
def test_calibrated_h(variant: str) -> None:
    needs(variant)
    described, camera = three_types(variant, 4096)
    found = responses_from_points(Setup(described, camera))
    dense, ideal = found.matrix.toarray(), ideal_matrix(camera).toarray()
    assert (dense[ideal > 0] > 0).all(), "light comes from everywhere where the closed form says"
    assert dense[ideal == 0].sum() < 1e-5 * dense.sum(), "but for rays rounded over an edge, only from there"
    rows = np.repeat(np.arange(camera.measurements), np.diff(found.matrix.indptr))
    difference = found.matrix.data - ideal[rows, found.matrix.indices]
    variance = np.maximum(found.variance, rounding_variance(found.matrix.data, found.samples))
    assert_student(difference, variance, found.passes)


@pytest.mark.parametrize("variant", VARIANTS)
def test_calibrated_h_of_ratios_that_are_no_whole_numbers(variant: str) -> None:
    """Footprints cut through pixels of f; one type's edges stand a hair from them, where float32 rounds either way."""
    needs(variant)
    lenses = (("2/7", [2, 2], [3, 2]), ("333333/1000000", [2, 2], [3, 4]), ("1/3", [1, 1], [4, 4]))
    data = scene((13, 14), lenses, render={"variant": variant, "seed": 2}, calibration={"samples": 4096}).plain()
    data["camera"]["lens"][0]["step"] = "1/3"
    described = parse(data, Path("test.toml"))
    camera = derive(described)
    found = responses_from_points(Setup(described, camera))
    dense, ideal = found.matrix.toarray(), ideal_matrix(camera).toarray()
    rows = np.repeat(np.arange(camera.measurements), np.diff(found.matrix.indptr))
    # Slivers thinner than one ray in a hundred passes are no matter of Student's t.
    thick = ideal[rows, found.matrix.indices] > 1e-3
    difference = (found.matrix.data - ideal[rows, found.matrix.indices])[thick]
    variance = np.maximum(found.variance, rounding_variance(found.matrix.data, found.samples))[thick]
    assert_student(difference, variance, found.passes)
    assert np.abs(dense - ideal)[ideal <= 1e-3].sum() < 1e-4 * dense.sum()
    np.testing.assert_allclose(dense.sum(axis=1), 1, atol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_ratios_that_are_no_whole_numbers(variant: str) -> None:
    """Footprints whose edges cut through pixels of the target, arrays that are not square, and magnification 1."""
    needs(variant)
    render = {"variant": variant, "samples": 16384, "seed": 5}
    described = scene((13, 15), UNUSUAL, render=render)
    camera = derive(described)
    image = load(described)
    rendering = light(Setup(described, camera, image))
    assert_student(rendering.mean - ideal_matrix(camera) @ image.ravel(), floored(rendering), rendering.passes)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_letter_f_comes_out_upright(variant: str) -> None:
    """One lens of magnification 1 shows the picture itself; neighbours see it shifted to the left and up."""
    needs(variant)
    letter = np.zeros((12, 12))
    letter[2:10, 3] = letter[2, 3:8] = letter[5, 3:6] = 200.0
    described = scene((12, 12), ((1, [2, 2], [9, 9]),), render={"variant": variant, "samples": 16})
    camera = derive(described)
    assert camera.types[0].origin == (1, 1)
    rendering = light(Setup(described, camera, letter))
    pictures = [rendering.mean[place].reshape(9, 9) for place in camera.slices()]
    for sub, picture in zip(camera.sub_imagers, pictures, strict=True):
        window = letter[1 + sub.k : 10 + sub.k, 1 + sub.l : 10 + sub.l]
        np.testing.assert_allclose(picture, window, atol=1e-3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_uniform_target_reads_its_own_value(variant: str) -> None:
    """To the rounding of a float32 film; a pinhole of finite depth does not darken towards the edge."""
    needs(variant)
    described, camera = three_types(variant, 256)
    rendering = light(Setup(described, camera, np.full((19, 19), 100.0)))
    np.testing.assert_allclose(rendering.mean, 100.0, rtol=2e-6)


@pytest.mark.parametrize(("sampler", "power"), [("independent", 0.5), ("multijitter", 0.75)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_error_falls_as_the_sampler_promises(variant: str, sampler: str, power: float) -> None:
    """Independent samples: n^-1/2. Stratified ones of an image of steps, whose strata along an edge err: n^-3/4."""
    needs(variant)
    error: dict[int, float] = {}
    for samples in (256, 256 * 16):
        described, camera = three_types(variant, samples, sampler)
        image = load(described)
        rendering = light(Setup(described, camera, image))
        difference = (rendering.mean - ideal_matrix(camera) @ image.ravel())[:450]  # 1/4 fills its strata exactly
        error[samples] = float(np.sqrt(np.mean(difference**2)))
    fell = error[256] / error[4096]
    assert fell == pytest.approx(16**power, rel=0.25), "each error of 450 pixels is known to 3 %, their ratio to 5 %"


@pytest.mark.parametrize("sampler", ["multijitter", "independent"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_variance_of_the_mean_is_the_real_one(variant: str, sampler: str) -> None:
    needs(variant)
    described, camera = three_types(variant, 1024, sampler)
    image = load(described)
    rendering = light(Setup(described, camera, image))
    difference = (rendering.mean - ideal_matrix(camera) @ image.ravel())[:450]
    # The mean of 450 squares over their variances, weighted by what both have in common.
    assert np.sum(difference**2) / np.sum(rendering.variance[:450]) == pytest.approx(1, abs=0.4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_noise_of_data_calibration_and_seeds_is_uncorrelated(variant: str) -> None:
    needs(variant)
    described, camera = three_types(variant, 64)
    image = load(described)
    ideal = ideal_matrix(camera) @ image.ravel()
    other, _ = three_types(variant, 64, seed=12)
    errors = [
        light(Setup(described, camera, image)).mean - ideal,
        light(Setup(other, camera, image)).mean - ideal,
        responses_from_points(Setup(described, camera)).matrix @ image.ravel() - ideal,
    ]
    for one, another in ((0, 1), (0, 2), (1, 2)):
        pair = np.array([errors[one][:450], errors[another][:450]])
        pair /= np.sqrt(ideal[:450] + 1)
        assert abs(np.corrcoef(pair)[0, 1]) < 4 / 450**0.5


@pytest.mark.parametrize("variant", VARIANTS)
def test_no_ray_slips_into_another_sub_imager(variant: str) -> None:
    """Film coordinates are float32 and round up to the next pixel's once in some hundred thousand rays.

    Every one of 256 sub-imagers looks into a block of one value, with a rim around its window: what a slipped ray
    brings from another block would show against the rounding of 256 equal values.
    """
    needs(variant)
    data = scene((98, 98), ((1, [16, 16], [4, 4]),), render={"variant": variant, "samples": 4096}).plain()
    data["camera"]["lens"][0]["step"] = 6
    described = parse(data, Path("test.toml"))
    camera = derive(described)
    assert camera.types[0].origin == (2, 2)
    blocks = np.random.default_rng(0).uniform(50.0, 250.0, (16, 16)).astype(np.float32).astype(np.float64)
    image = np.pad(np.kron(blocks, np.ones((6, 6))), 1, mode="edge").astype(np.float64)
    rendering = light(Setup(described, camera, image))
    np.testing.assert_allclose(
        rendering.mean.reshape(256, 16), np.repeat(blocks.reshape(256, 1), 16, axis=1), rtol=1e-5
    )
