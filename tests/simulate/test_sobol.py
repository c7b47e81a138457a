"""Sobol's points of pixel and pupil: evenly spread, independent between pixels and passes, and honest variances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.adaptive_render import render_until
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.draws import DIMENSIONS, SobolDraws
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import activate

from ..examples import needs, with_optics

FAST = "llvm_ad_mono"
LANES, SAMPLES = 2**16, 64


@pytest.fixture(autouse=True)
def _fast() -> None:
    needs(FAST)
    activate(FAST)


def out_of_focus(seed: int = 0, noise: float = 1.0, **render: Any) -> Setup:
    """A thin lens for rays alone, whose H has a closed form."""
    tables: Any = {"render": {"samples": "auto", "seed": seed, "variant": FAST, **render}, "noise": {"variance": noise}}
    optics = {"aperture": "0.4 mm", "focus": "900 mm"}
    return Setup(*with_optics(optics, {"wavelength": "none"}, (("1/3", [2, 2], [5, 5]),), **tables))


def draws(seed: int = 3) -> FloatArray:
    """Return numbers of all dimensions and of one more, (dimensions + 1, streams, samples)."""
    drawn = SobolDraws(seed, LANES, SAMPLES)
    return np.stack([np.array(drawn.next_1d()) for _ in range(DIMENSIONS + 1)]).reshape(-1, LANES // SAMPLES, SAMPLES)


def test_every_stratum_of_every_dimension_holds_one_point() -> None:
    """Scrambling keeps the net: one of 64 points is in each 64th of a dimension, and in each of 8 x 8 cells."""
    numbers = draws()
    assert (numbers >= 0).all()
    assert (numbers < 1).all()
    strata = np.sort((numbers[:DIMENSIONS] * SAMPLES).astype(int), axis=2)
    assert (strata == np.arange(SAMPLES)).all()
    cells = np.sort((numbers[0] * 8).astype(int) * 8 + (numbers[1] * 8).astype(int), axis=1)
    assert (cells == np.arange(SAMPLES)).all()
    beyond = np.sort((numbers[-1] * SAMPLES).astype(int), axis=1)
    assert not (beyond == np.arange(SAMPLES)).all(axis=1).any(), "further numbers are independent"


def test_points_are_uniform_and_those_of_streams_and_seeds_are_unrelated() -> None:
    """Each point of the net is uniform within its stratum over the streams, and means of streams are independent."""
    numbers = draws()
    for dimension in numbers:
        first = dimension[:, 5]  # the same point of the net in every stream
        assert stats.kstest(first, "uniform").pvalue > 1e-4
        inside = (dimension * SAMPLES) % 1
        assert stats.kstest(inside[:, ::8].ravel(), "uniform").pvalue > 1e-4
    means = numbers.mean(axis=2) - 0.5
    others = draws(4).mean(axis=2) - 0.5
    limit = stats.norm.isf(1e-5) / (LANES // SAMPLES) ** 0.5
    for one, two in zip(means, others, strict=True):
        assert abs(np.corrcoef(one[1:], one[:-1])[0, 1]) < limit
        assert abs(np.corrcoef(one, two)[0, 1]) < limit
    between = np.corrcoef(means)
    assert np.abs(between - np.eye(len(means))).max() < limit


def variance(sampler: Sampler, sobol: bool) -> float:
    """Return the variance of a pass of 1024 samples through a thin lens out of focus, mean over the pixels."""
    setup = out_of_focus(sampler=sampler)
    renderer = Renderer(setup.simulated, FAST, sampler)
    renderer.set_target(setup.image)
    seeds = [sampler_seeds(1, "data", number, 40) for number in range(40)]
    points = "sobol" if sobol else "sampler"
    passes = [renderer.expose(renderer.sub_imagers([index]), 1024, seeds, points)[0] for index in range(4)]
    return float(np.concatenate(passes, axis=1).var(axis=0, ddof=1).mean())


def test_their_variance_is_far_below_that_of_samplers_of_pixel_and_pupil_apart() -> None:
    """With exact averages over the pixel; the ratio of two variances of 100 pixels, 40 passes each, is known to 4 %."""
    assert variance("multijitter", False) / variance("multijitter", True) > 20


def test_stated_variances_are_those_of_the_error() -> None:
    """Over 20 seeds, against the closed form of H: squared errors over stated variances have a mean of 1 (t test)."""
    ratios: list[float] = []
    for seed in range(20):
        setup = out_of_focus(seed)
        rendering = render_until(setup)
        assert rendering.record["sampler"] == "sobol"
        assert rendering.record["reached"]
        error = rendering.mean - ideal_matrix(setup.camera) @ setup.image.ravel()
        ratios.append(float(np.sum(error**2) / np.sum(rendering.variance)))
    mean, deviation = np.mean(ratios), np.std(ratios, ddof=1) / len(ratios) ** 0.5
    assert abs(mean - 1) < stats.t.isf(0.005, len(ratios) - 1) * deviation, f"{mean:.3f} +- {deviation:.3f}"
    assert deviation < 0.2, "half of the variance would be seen"


LENSES: list[tuple[dict[str, Any], dict[str, Any], str, int]] = [
    ({"aperture": "0.4 mm"}, {}, "1/3", 1),
    ({"aperture": "0.4 mm"}, {}, "1/4", 3),
    ({"aperture": "0.8 mm", "focus": "900 mm"}, {"wavelength": "none"}, "2/7", 1),
]


@pytest.mark.parametrize(("optics", "camera", "ratio", "detail"), LENSES)
def test_averages_over_pixels_are_those_of_the_closed_form(
    optics: dict[str, Any], camera: dict[str, Any], ratio: str, detail: int
) -> None:
    """Readings at the edges of the target included, of a picture of noise: errors are as stated, and small."""
    size = (14, 15)
    tables: Any = {"render": {"samples": "auto", "variant": FAST}, "noise": {"variance": 1e-1}}
    lenses = ((ratio, [2, 3], [3, 3]),)
    described, _ = with_optics(optics, {"lens_pitch": "1 mm", **camera}, lenses, size, **tables)
    described = described.model_copy(update={"target": described.target.model_copy(update={"detail": detail})})
    setup = Setup.from_scene(described)
    shape = setup.world.camera.shape
    setup = Setup(described, setup.camera, np.random.default_rng(0).uniform(0, 255, shape))
    rendering = render_until(setup)
    error = rendering.mean - ideal_matrix(setup.world.camera) @ setup.world.image.ravel()
    assert float(np.mean(np.square(error))) < 0.1 * 1e-1
    squares = np.square(error) / rendering.variance
    assert float(squares.mean()) < 1 + 5 * float(squares.std()) / squares.size**0.5
    assert abs(float(error.mean())) < 0.01


def test_another_sampler_is_respected() -> None:
    assert render_until(out_of_focus(sampler="independent", noise=30.0)).record["sampler"] == "independent"
