"""An unknown common level of the image, against the estimate for a prior with one covariance more, P0 + L^2 1 1^T."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from tests.examples import THREE, Lenses
from tests.frames import FITTED, P0, recorded, wide

ONE: Lenses = (("1/3", [3, 3], "fit"),)
SIDE, NOISE, LEVEL = 23, 1.0, 64.0


def described(lenses: Lenses, method: str, **prior: Any) -> Scene:
    scene = wide((SIDE, SIDE), lenses, noise={"variance": NOISE}, prior={"level": LEVEL} | prior)
    return scene.model_copy(update={"estimator": scene.estimator.model_copy(update={"method": method})})


def dark(seed: int) -> FloatArray:
    """A dark picture whose pixels vary much less than the prior's."""
    return 12 + 5 * np.random.default_rng(seed).random(SIDE * SIDE)


def restored(scene: Scene, picture: FloatArray, seed: int = 0) -> Reconstruction:
    stack = recorded(scene, picture, NOISE, seed)
    return restore(stack, ideal_model(scene, stack.camera), picture)


def exact(scene: Scene, actual: float, ratio: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """A' of the estimate, (N, M), and the covariance of its error, (N, N), for other noise and c P0."""
    stack = recorded(scene, dark(0), NOISE)
    matrix = ideal_matrix(stack.camera).toarray()
    count = matrix.shape[1]
    common = LEVEL**2 * np.ones((count, count))
    prior = P0 * np.eye(count) + common
    expected = NOISE * np.eye(len(matrix))
    gain = prior @ matrix.T @ np.linalg.inv(matrix @ prior @ matrix.T + expected)
    left = np.eye(count) - gain @ matrix
    return gain, left @ (ratio * P0 * np.eye(count) + common) @ left.T + actual * gain @ gain.T


@pytest.mark.parametrize("method", ["auto", "frame"])
@pytest.mark.parametrize("lenses", [ONE, FITTED, (("2/7", [4, 4], "fit"),)])
def test_the_estimate_is_that_of_a_prior_with_one_covariance_more(lenses: Lenses, method: str) -> None:
    scene, picture = described(lenses, method), dark(1)
    result = restored(scene, picture)
    gain, covariance = exact(scene, NOISE)
    stack = recorded(scene, picture, NOISE)
    mean = np.full(picture.size, 127.5)
    estimate = mean + gain @ (stack.values - ideal_matrix(stack.camera) @ mean)
    deviation = np.sqrt(np.diagonal(covariance))
    assert np.abs(result.estimate - estimate).max() < 0.02 * deviation.min()
    np.testing.assert_allclose(result.expected.variance, deviation**2, rtol=0.01)
    for corner, size in (((0, 0), (SIDE, SIDE)), ((3, 2), (5, 5)), ((SIDE - 1, SIDE - 1), (1, 1))):
        weights = np.zeros((SIDE, SIDE))
        weights[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = 1 / np.prod(size)
        mean_of, deviation_of = result.region(corner, size)
        weight = weights.ravel()
        assert mean_of == pytest.approx(weight @ estimate, abs=0.02 * deviation_of)
        assert deviation_of == pytest.approx(float(weight @ covariance @ weight) ** 0.5, rel=0.01)
    assert result.interval is not None
    assert result.verdict.level != "red"


@pytest.mark.parametrize("ratio", [1.0, 0.3])
@pytest.mark.parametrize("lenses", [ONE, FITTED])
def test_noise_and_pixels_other_than_the_estimator_expects(lenses: Lenses, ratio: float) -> None:
    scene = described(lenses, "auto")
    expecting = replace_tables(
        scene,
        noise={"variance": 9 * NOISE},
        prior={"variance": ratio * P0},
        estimator={"noise_variance": NOISE, "prior_variance": P0},
    )
    _, covariance = exact(scene, 9 * NOISE, ratio)
    stack = recorded(expecting, dark(0), 9 * NOISE)
    result = restore(stack, ideal_model(expecting, stack.camera), dark(0))
    np.testing.assert_allclose(result.expected.variance, np.diagonal(covariance), rtol=1e-6)
    assert result.region((0, 0), (SIDE, SIDE))[1] == pytest.approx(float(covariance.mean()) ** 0.5, rel=1e-6)
    parts = result.expected.missing + sum(result.expected.parts.values())
    assert parts == pytest.approx(result.expected.variance.mean(), rel=1e-9)


def replace_tables(scene: Scene, **tables: dict[str, Any]) -> Scene:
    """The scene with some keys of its tables changed."""
    changed = {name: getattr(scene, name).model_copy(update=keys) for name, keys in tables.items()}
    return scene.model_copy(update=changed)


@pytest.mark.parametrize("pictures", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_means_of_regions_of_dark_pictures_deviate_by_what_is_stated(pictures: int) -> None:
    """With a known level the whole is three of its deviations too bright."""
    found: list[list[float]] = []
    for level in ("known", LEVEL):
        scene = described(ONE, "frame", level=level)
        stack = recorded(scene, dark(2), NOISE)
        model, ratios = ideal_model(scene, stack.camera), []
        for seed in range(pictures):
            picture = dark(seed)
            result = restore(replace(stack, values=recorded(scene, picture, NOISE, seed).values), model)
            mean, deviation = result.region((0, 0), (SIDE, SIDE))
            ratios.append((mean - float(picture.mean())) / deviation)
        found.append(ratios)
    known, unknown = (float(np.mean(np.square(ratios))) ** 0.5 for ratios in found)
    assert known > 3
    assert unknown < 1.5


def test_tiles_refuse_a_level() -> None:
    with pytest.raises(InputError, match=r"takes the level of the image for known, got prior.level 64"):
        wide((SIDE, SIDE), ONE, prior={"level": LEVEL}, estimator={"method": "tiles"})
    wide((SIDE, SIDE), ONE, estimator={"method": "tiles"})


def test_a_known_level_is_the_prior_of_the_paper() -> None:
    scene = described(THREE, "auto", level="known")
    stack = recorded(scene, dark(0), NOISE)
    matrix = ideal_matrix(stack.camera).toarray()
    information = matrix.T @ matrix / NOISE + np.eye(matrix.shape[1]) / P0
    expected = (
        127.5 + np.linalg.solve(information, matrix.T @ (stack.values - matrix @ np.full(SIDE**2, 127.5))) / NOISE
    )
    result = restore(stack, ideal_model(scene, stack.camera))
    np.testing.assert_allclose(result.estimate, expected, atol=1e-6)
