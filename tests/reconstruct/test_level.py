"""An unknown common level of the image, against the estimate for a prior with one covariance more, P0 + L^2 1 1^T."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from tests.examples import Lenses, gain_and_error, with_keys
from tests.frames import FITTED, P0, recorded, wide

ONE: Lenses = (("1/3", [3, 3], "fit"),)
SIDE, NOISE, LEVEL = 23, 1.0, 64.0


def described(lenses: Lenses, method: str, **prior: Any) -> Scene:
    scene = wide((SIDE, SIDE), lenses, noise={"variance": NOISE}, prior={"level": LEVEL} | prior)
    return with_keys(scene, estimator={"method": method})


def dark(seed: int) -> FloatArray:
    """A dark picture whose pixels vary much less than the prior's."""
    return 12 + 5 * np.random.default_rng(seed).random(SIDE * SIDE)


def restored(scene: Scene, picture: FloatArray, seed: int = 0) -> Reconstruction:
    stack = recorded(scene, picture, NOISE, seed)
    return restore(stack, ideal_model(scene, stack.camera), picture)


def exact(scene: Scene, actual: float, ratio: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """A' of the estimate, (N, M), and the covariance of its error, (N, N), for other noise and c P0."""
    matrix = ideal_matrix(derive(scene)).toarray()
    pixels, common = P0 * np.eye(SIDE**2), np.full((SIDE**2, SIDE**2), LEVEL**2)
    return gain_and_error(matrix, pixels + common, NOISE, ratio * pixels + common, actual)


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
    expecting = with_keys(
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


def test_tiles_refuse_a_level() -> None:
    with pytest.raises(InputError, match=r"takes the level of the image for known, got prior.level 64"):
        wide((SIDE, SIDE), ONE, prior={"level": LEVEL}, estimator={"method": "tiles"})
    wide((SIDE, SIDE), ONE, estimator={"method": "tiles"})
