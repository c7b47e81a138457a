"""Readings that little noise dithers: errors of rounding are common to measurements of like light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, stats

from ommatid.reconstruct.noise import common_rounding
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.simulate.ideal import ideal_model

from ..frames import FITTED, recorded, wide

VARIANCE, SEEDS = 1e-3, 24  # 0.03 steps of eight bits
SIGNIFICANCE = 1e-3


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2, 0.4])
def test_the_common_variance_is_the_mean_square_of_the_mean_error(noise: float) -> None:
    """Over lights spread evenly within a step, the expected reading from the normal distribution at every edge."""
    light = (np.arange(4000) + 0.5) / 4000
    edges = np.arange(-8, 9) + 0.5
    above = stats.norm.sf(edges, light[:, None], noise) if noise else (light[:, None] > edges).astype(np.float64)
    error = above.sum(axis=1) - 8 - light
    step = 0.25
    rounding = np.full(4000, step**2 / 12)
    # Dark frames have the same error in every exposure, which dithers none of them.
    variances = {"noise": np.full(4000, (noise * step) ** 2), "quantisation": rounding, "frames": rounding}
    columns = common_rounding(variances, step * light)
    found = np.square(columns).sum(axis=0)
    np.testing.assert_allclose(found, step**2 * np.square(error).mean(), rtol=0.05, atol=1e-12)
    assert columns[0] @ columns[1] == pytest.approx(0, abs=1e-9 + 1e-3 * found.sum())


def rounded(kind: str, shape: tuple[int, int], seed: int) -> tuple[Reconstruction, FloatArray]:
    """The reconstruction of a picture at eight bits, and its truth."""
    rng = np.random.default_rng(seed)
    truth = np.full(shape, rng.uniform(20, 220))
    if kind == "smooth":
        truth += 6 * ndimage.gaussian_filter(rng.normal(size=shape), 3)
    if kind == "ramp":
        truth = 40 + 150 * np.linspace(0, 1, shape[0] * shape[1]).reshape(shape)
    described = wide(shape, FITTED, noise={"variance": VARIANCE, "bits": 8}, prior={"kind": "fit"})
    stack = recorded(described, truth.ravel(), VARIANCE, seed)
    stack = replace(stack, values=np.round(stack.values))
    return restore(stack, ideal_model(described, derive(described)), truth.ravel()), truth


@pytest.mark.parametrize(
    ("kind", "shape", "seeds"),
    [
        ("flat", (13, 13), 3),
        pytest.param("smooth", (19, 19), SEEDS, marks=pytest.mark.slow),
        pytest.param("ramp", (19, 19), SEEDS, marks=pytest.mark.slow),
        pytest.param("flat", (47, 45), SEEDS, marks=pytest.mark.slow),
    ],
)
def test_means_of_smooth_pictures_err_by_what_is_stated(kind: str, shape: tuple[int, int], seeds: int) -> None:
    """The largest error of a mean is half a step, and what is stated root 12 times less than one: at most 1.7 times."""
    scores: list[list[float]] = []
    inside = 0
    for seed in range(seeds):
        found, truth = rounded(kind, shape, seed)
        assert found.verdict.trusted
        assert any("times the quantisation step" in note for note in found.verdict.notes)
        assert found.interval is not None
        inside += float(np.square(found.estimate - truth.ravel()).mean()) <= found.interval.high
        regions = ((5, 6), (1, 1)), ((3, 4), (5, 5)), ((0, 0), shape)
        means = [found.region(*region) for region in regions]
        true = [truth[r : r + h, c : c + w].mean() for (r, c), (h, w) in regions]
        scores.append([(mean - value) / deviation for (mean, deviation), value in zip(means, true, strict=True)])
    assert inside >= stats.binom.ppf(SIGNIFICANCE, seeds, 0.99)
    squares = np.square(scores).sum(axis=0)
    assert (squares < stats.chi2.ppf(1 - SIGNIFICANCE, seeds)).all()
    if kind == "flat":
        assert (squares > stats.chi2.ppf(SIGNIFICANCE, seeds)).all()
