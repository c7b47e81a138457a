"""An estimator that assumes another variance of the prior than the actual one, against Eq. 5 in dense matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ommatid.analysis.predict import predict_scene
from ommatid.analysis.run_prediction import predict_run
from ommatid.reconstruct.prior import prior_of
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from ommatid.simulate.render import exposed

from ..examples import Lenses, covariance_of, gain_and_error, needs, not_none, scene, with_keys

ACTUAL, NOISE = 5461.25, 4.0
LENSES: Lenses = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))
SMOOTH = {"kind": "exponential", "correlation_length": "3 mm"}


def described(assumed: float, shape: tuple[int, int] = (12, 12), **tables: Any) -> Scene:
    """A scene with a null space and loud noise, so that the prior matters."""
    estimator = {"prior_variance": assumed, **tables.pop("estimator", {})}
    noise, ideal = {"variance": NOISE}, {"method": "ideal"}
    prior = {"level": "known", **tables.pop("prior", {})}
    return scene(shape, LENSES, noise=noise, calibration=ideal, estimator=estimator, prior=prior, **tables)


def dense(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return A and the covariance of the error by Eq. 5."""
    camera = derive(scene)
    actual, assumed = (
        covariance_of(prior_of(table, camera.shape, 1.0, 1)) for table in (scene.prior, scene.assumed_prior)
    )
    return gain_and_error(ideal_matrix(camera).toarray(), assumed, NOISE, actual)


def reconstructed(scene: Scene, seed: int) -> Reconstruction:
    """Reconstruct an image drawn with the actual variance."""
    camera, rng = derive(scene), np.random.default_rng(seed)
    prior = prior_of(scene.prior, camera.shape, 1.0)
    image = prior.mean + prior.apply_root(rng.normal(size=prior.dimension))
    seeded = with_keys(scene, render={"seed": seed})
    model = ideal_model(seeded, camera)
    stack = exposed(
        Setup(seeded, camera, image.reshape(camera.shape)), model.forward(image), np.zeros(model.measurements), {}
    )
    return restore(stack, model, image)


@pytest.mark.parametrize("assumed", [50.0, 1e6])
@pytest.mark.parametrize("prior", [{}, SMOOTH])
def test_the_prediction_and_the_error_map_are_those_of_equation_5(assumed: float, prior: dict[str, Any]) -> None:
    scene = described(assumed, prior=prior)
    variance = np.diag(dense(scene)[1])
    assert predict_scene(scene, rays=False).mse == pytest.approx(variance.mean(), rel=1e-8)
    assert predict_scene(scene, rays=False).prior_variance == pytest.approx(ACTUAL)
    done = reconstructed(scene, 0)
    np.testing.assert_allclose(done.expected.variance, variance, rtol=1e-7)
    assert sum(done.budget().values()) == pytest.approx(variance.mean(), rel=1e-7)
    _, deviation = done.region((4, 5), (3, 2))
    weights = np.zeros((12, 12))
    weights[4:7, 5:7] = 1 / 6
    assert deviation**2 == pytest.approx(weights.ravel() @ dense(scene)[1] @ weights.ravel(), rel=1e-7)


@pytest.mark.parametrize("assumed", [50.0, 1e6])
def test_the_prediction_of_a_run_holds_the_actual_prior(assumed: float) -> None:
    """With an assumed noise the rendering's noise changes no gain, and is a part of its own."""
    needs("llvm_ad_mono")
    scene = described(assumed, estimator={"noise_variance": NOISE})
    budget = not_none(predict_run(Setup.from_scene(scene)).budget)
    assert budget["null_space"] + budget["noise"] == pytest.approx(np.diag(dense(scene)[1]).mean(), rel=1e-7)


def test_the_estimate_is_that_of_the_assumed_variance() -> None:
    assumed = reconstructed(described(50.0), 3)
    recorded = assumed.task.recorded
    gain, _ = dense(described(50.0))
    image = 127.5 + gain @ (recorded - 127.5 * ideal_matrix(derive(described(50.0))).toarray().sum(axis=1))
    np.testing.assert_allclose(assumed.estimate, image, rtol=1e-8)


@pytest.mark.parametrize(("method", "assumed"), [("tiles", 1e6), ("frame", 50.0)])
def test_tiles_and_frames_state_the_error_of_equation_5(method: str, assumed: float) -> None:
    scene = described(assumed, (30, 30), estimator={"method": method}, tiles={"size": 30, "overlap": 0})
    tolerance = 1e-6 if method == "tiles" else 0.01  # estimator.accuracy of a frame
    np.testing.assert_allclose(reconstructed(scene, 0).expected.variance, np.diag(dense(scene)[1]), rtol=tolerance)


def test_the_residual_is_expected_for_the_actual_prior() -> None:
    """Over images of the actual prior chi-squared of the residual has the mean of a dense calculation."""
    scene = described(50.0)
    camera = derive(scene)
    gain, _ = dense(scene)
    h = ideal_matrix(camera).toarray()
    left = np.eye(len(h)) - h @ gain
    mean = np.trace(left @ (ACTUAL * h @ h.T + NOISE * np.eye(len(h))) @ left.T) / NOISE
    whole = reconstructed(scene, 0).verdict.parts[0]
    assert whole.prior == pytest.approx(mean, rel=0.1), "32 draws of images and noise"


@pytest.mark.parametrize(
    ("tables", "conflict"),
    [
        ({"prior": {"kind": "fit"}}, "prior.kind 'fit'"),
        ({"estimator": {"misalignment": "fit"}}, "misalignment 'trust', got 'fit'"),
    ],
)
def test_an_assumed_variance_beside_a_prior_that_is_not_known_is_refused(tables: dict[str, Any], conflict: str) -> None:
    with pytest.raises(InputError, match=conflict):
        described(50.0, **tables)
