"""Eq. 4 and 5 with inverses: unknown levels, and priors and noise other than those that the estimator assumes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ommatid.analysis.predict import predict_scene
from ommatid.analysis.run_prediction import predict_run
from ommatid.reconstruct.prior import coloured, prior_of, spectrum_of
from ommatid.reconstruct.restore import restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import Lenses, covariance_of, gain_and_error, needs, not_none, with_keys
from ..frames import FITTED, P0, recorded, wide

ONE: Lenses = (("1/3", [3, 3], "fit"),)
PAIR: Lenses = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))  # with a null space, so that the prior matters
SMOOTH = {"kind": "exponential", "correlation_length": "3 mm"}
NOISE = 4.0


def with_level(lenses: Lenses, method: str = "auto", **tables: dict[str, Any]) -> Scene:
    """An image of unknown level: its prior has one covariance more, L^2 1 1^T."""
    scene = wide((23, 23), lenses, noise={"variance": 1.0}, prior={"level": 64.0})
    return with_keys(with_keys(scene, estimator={"method": method}), **tables)


def other(lenses: Lenses, ratio: float) -> Scene:
    """Noise and pixels other than the estimator expects."""
    estimator = {"noise_variance": 1.0, "prior_variance": P0}
    return with_level(lenses, noise={"variance": 9.0}, prior={"variance": ratio * P0}, estimator=estimator)


def assuming(variance: float, shape: tuple[int, int] = (12, 12), prior: Any = None, **tables: Any) -> Scene:
    """A known level, and another variance of the pixels than the actual one."""
    estimator = {"prior_variance": variance, **tables.pop("estimator", {})}
    known, noise = {"level": "known", **(prior or {})}, {"variance": NOISE}
    return wide(shape, PAIR, noise=noise, calibration={"method": "ideal"}, prior=known, estimator=estimator, **tables)


def dense(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """A and the covariance of the error by Eq. 5."""
    camera, noise = derive(scene), not_none(scene.noise).variance
    actual, assumed = (
        covariance_of(prior_of(table, camera.shape, 1.0, 1)) + scene.prior.level_deviation**2
        for table in (scene.prior, scene.assumed_prior)
    )
    expected = scene.estimator.noise_variance or noise
    assert isinstance(expected, float)
    return gain_and_error(ideal_matrix(camera).toarray(), assumed, expected, actual, noise)


CASES: dict[str, tuple[Callable[[], Scene], float]] = {  # and the accuracy of error bars
    **{
        f"level, {method}, {name}": (lambda lenses=lenses, method=method: with_level(lenses, method), 0.01)
        for method in ("auto", "frame")
        for name, lenses in (("one", ONE), ("three", FITTED), ("fraction", (("2/7", [4, 4], "fit"),)))
    },
    **{
        f"other noise and pixels, {ratio}, {name}": (lambda lenses=lenses, ratio=ratio: other(lenses, ratio), 1e-6)
        for ratio in (1.0, 0.3)
        for name, lenses in (("one", ONE), ("three", FITTED))
    },
    **{
        f"assumed {variance}, {name}": (lambda variance=variance, prior=prior: assuming(variance, prior=prior), 1e-7)
        for variance in (50.0, 1e6)
        for name, prior in (("pixels", None), ("waves", SMOOTH))
    },
    "tiles": (lambda: assuming(1e6, (30, 30), estimator={"method": "tiles"}, tiles={"size": 30, "overlap": 0}), 1e-6),
    "frame": (lambda: assuming(50.0, (30, 30), estimator={"method": "frame"}), 0.01),
}


@pytest.mark.parametrize("name", CASES)
def test_estimate_error_bars_and_regions(name: str) -> None:
    """Of a dark picture whose pixels vary much less than the prior's where the level is unknown, else of a draw."""
    scene, accuracy = CASES[name][0](), CASES[name][1]
    shape, rng = derive(scene).shape, np.random.default_rng(1)
    draw = 127.5 + coloured(spectrum_of(scene.prior, shape, 1.0), rng.normal(size=shape)).ravel()
    picture = 12 + 5 * rng.random(draw.size) if scene.prior.level_deviation else draw
    stack, (gain, covariance) = recorded(scene, picture, not_none(scene.noise).variance), dense(scene)
    result, mean = restore(stack, ideal_model(scene, stack.camera), picture), np.full(picture.size, 127.5)
    estimate = mean + gain @ (stack.values - ideal_matrix(stack.camera) @ mean)
    deviation = np.sqrt(np.diagonal(covariance))
    assert np.abs(result.estimate - estimate).max() < 2 * accuracy * deviation.min()
    np.testing.assert_allclose(result.expected.variance, deviation**2, rtol=accuracy)
    assert sum(result.budget().values()) == pytest.approx(result.expected.mse, rel=1e-7)
    for corner, size in (((0, 0), shape), ((3, 2), (5, 4)), ((shape[0] - 1, shape[1] - 1), (1, 1))):
        weights = np.zeros(shape)
        weights[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = 1 / np.prod(size)
        mean_of, deviation_of = result.region(corner, size)
        weight = weights.ravel()
        assert mean_of == pytest.approx(weight @ estimate, abs=2 * accuracy * deviation_of)
        assert deviation_of == pytest.approx(float(weight @ covariance @ weight) ** 0.5, rel=accuracy)
    assert result.interval is not None
    assert result.verdict.level != "red" or "other" in name


@pytest.mark.parametrize("variance", [50.0, 1e6])
@pytest.mark.parametrize("prior", [None, SMOOTH])
def test_predictions_hold_the_actual_prior(variance: float, prior: dict[str, Any] | None) -> None:
    """That of a run with an assumed noise, too: the rendering's noise changes no gain, and is a part of its own."""
    scene = assuming(variance, prior=prior)
    expected, prediction = np.diagonal(dense(scene)[1]).mean(), predict_scene(scene, rays=False)
    assert (prediction.mse, prediction.prior_variance) == pytest.approx((expected, P0), rel=1e-8)
    if prior is None:
        needs("llvm_ad_mono")
        run = predict_run(Setup.from_scene(with_keys(scene, estimator={"noise_variance": NOISE})))
        budget = not_none(run.budget)
        assert budget["null_space"] + budget["noise"] == pytest.approx(expected, rel=1e-7)


def test_the_residual_is_expected_for_the_actual_prior() -> None:
    """Over images of the actual prior chi-squared of the residual has the mean of a dense calculation."""
    scene = assuming(50.0)
    h, (gain, _) = ideal_matrix(derive(scene)).toarray(), dense(scene)
    left = np.eye(len(h)) - h @ gain
    mean = np.trace(left @ (P0 * h @ h.T + NOISE * np.eye(len(h))) @ left.T) / NOISE
    stack = recorded(scene, np.random.default_rng(0).normal(127.5, P0**0.5, 144), NOISE)
    whole = restore(stack, ideal_model(scene, stack.camera)).verdict.parts[0]
    assert whole.prior == pytest.approx(mean, rel=0.1), "32 draws of images and noise"


@pytest.mark.parametrize(
    ("make", "conflict"),
    [
        (lambda: assuming(50.0, prior={"kind": "fit"}), "prior.kind 'fit'"),
        (lambda: assuming(50.0, estimator={"misalignment": "fit"}), "misalignment 'trust', got 'fit'"),
        (lambda: wide((23, 23), ONE, prior={"level": 64.0}, estimator={"method": "tiles"}), "got prior.level 64"),
    ],
)
def test_what_is_assumed_beside_what_is_not_known_is_refused(make: Callable[[], Scene], conflict: str) -> None:
    with pytest.raises(InputError, match=conflict):
        make()
    wide((23, 23), ONE, estimator={"method": "tiles"})
