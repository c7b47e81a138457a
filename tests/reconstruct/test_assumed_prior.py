"""An estimator that assumes another variance of the prior than the actual one, against Eq. 5 in dense matrices."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ommatid.analysis.predict import predict_scene
from ommatid.analysis.run_prediction import predict_run
from ommatid.reconstruct.misalignment.moments import misaligned_moments, mismatch_variance
from ommatid.reconstruct.prior import independent, prior_of
from ommatid.reconstruct.problem import Problem
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.simulate.ideal import ideal_matrix, ideal_model, true_matrix
from ommatid.simulate.render import exposed

from ..examples import Lenses, form_of, needs, scene

ACTUAL, NOISE = 5461.25, 4.0
LENSES: Lenses = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))
SMOOTH = {"kind": "exponential", "correlation_length": "3 mm"}


def described(assumed: float, shape: tuple[int, int] = (12, 12), **tables: Any) -> Scene:
    """A scene with a null space and loud noise, so that the prior matters."""
    estimator = {"prior_variance": assumed, **tables.pop("estimator", {})}
    noise, ideal = {"variance": NOISE}, {"method": "ideal"}
    prior = {"level": "known", **tables.pop("prior", {})}
    return scene(shape, LENSES, noise=noise, calibration=ideal, estimator=estimator, prior=prior, **tables)


def dense(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, I - A H and the covariance of the error by Eq. 5, with inverses."""
    camera = derive(scene)
    h = ideal_matrix(camera).toarray()
    actual, assumed = (prior_of(table, camera.shape, 1.0, 1) for table in (scene.prior, scene.assumed_prior))
    p0m, p0 = (
        np.diag(np.square(prior.root)) if prior.independent else prior.root @ prior.root.T
        for prior in (actual, assumed)
    )
    gain = np.asarray(p0 @ h.T @ np.linalg.inv(h @ p0 @ h.T + NOISE * np.eye(len(h))), dtype=np.float64)
    hidden = np.eye(camera.unknowns) - gain @ h
    return gain, hidden, hidden @ p0m @ hidden.T + NOISE * gain @ gain.T


def reconstructed(scene: Scene, seed: int) -> Reconstruction:
    """Reconstruct an image drawn with the actual variance."""
    camera, rng = derive(scene), np.random.default_rng(seed)
    prior = prior_of(scene.prior, camera.shape, 1.0)
    image = prior.mean + prior.apply_root(rng.normal(size=prior.dimension))
    seeded = scene.model_copy(update={"render": scene.render.model_copy(update={"seed": seed})})
    model = ideal_model(seeded, camera)
    stack = exposed(
        Setup(seeded, camera, image.reshape(camera.shape)), model.forward(image), np.zeros(model.measurements), {}
    )
    return restore(stack, model, image)


@pytest.mark.parametrize("assumed", [50.0, 1e6])
@pytest.mark.parametrize("prior", [{}, SMOOTH])
def test_the_prediction_and_the_error_map_are_those_of_equation_5(assumed: float, prior: dict[str, Any]) -> None:
    scene = described(assumed, prior=prior)
    variance = np.diag(dense(scene)[2])
    assert predict_scene(scene, rays=False).mse == pytest.approx(variance.mean(), rel=1e-8)
    assert predict_scene(scene, rays=False).prior_variance == pytest.approx(ACTUAL)
    done = reconstructed(scene, 0)
    np.testing.assert_allclose(done.expected.variance, variance, rtol=1e-7)
    assert sum(done.budget().values()) == pytest.approx(variance.mean(), rel=1e-7)
    _, deviation = done.region((4, 5), (3, 2))
    weights = np.zeros((12, 12))
    weights[4:7, 5:7] = 1 / 6
    assert deviation**2 == pytest.approx(weights.ravel() @ dense(scene)[2] @ weights.ravel(), rel=1e-7)


@pytest.mark.parametrize("assumed", [50.0, 1e6])
def test_the_prediction_of_a_run_holds_the_actual_prior(assumed: float) -> None:
    """With an assumed noise the rendering's noise changes no gain, and is a part of its own."""
    needs("llvm_ad_mono")
    scene = described(assumed, estimator={"noise_variance": NOISE})
    budget = predict_run(Setup.from_scene(scene)).budget
    assert budget is not None
    assert budget["null_space"] + budget["noise"] == pytest.approx(np.diag(dense(scene)[2]).mean(), rel=1e-7)


def test_the_estimate_is_that_of_the_assumed_variance() -> None:
    assumed = reconstructed(described(50.0), 3)
    recorded = assumed.task.recorded
    gain, _, _ = dense(described(50.0))
    image = 127.5 + gain @ (recorded - 127.5 * ideal_matrix(derive(described(50.0))).toarray().sum(axis=1))
    np.testing.assert_allclose(assumed.estimate, image, rtol=1e-8)


@pytest.mark.parametrize(("method", "assumed"), [("tiles", 1e6), ("frame", 50.0)])
def test_tiles_and_frames_state_the_error_of_equation_5(method: str, assumed: float) -> None:
    scene = described(assumed, (30, 30), estimator={"method": method}, tiles={"size": 30, "overlap": 0})
    tolerance = 1e-6 if method == "tiles" else 0.01  # estimator.accuracy of a frame
    np.testing.assert_allclose(reconstructed(scene, 0).expected.variance, np.diag(dense(scene)[2]), rtol=tolerance)


def test_the_residual_is_expected_for_the_actual_prior() -> None:
    """Over images of the actual prior chi-squared of the residual has the mean of a dense calculation."""
    scene = described(50.0)
    camera = derive(scene)
    gain, _, _ = dense(scene)
    h = ideal_matrix(camera).toarray()
    left = np.eye(len(h)) - h @ gain
    mean = np.trace(left @ (ACTUAL * h @ h.T + NOISE * np.eye(len(h))) @ left.T) / NOISE
    whole = reconstructed(scene, 0).verdict.parts[0]
    assert whole.prior == pytest.approx(mean, rel=0.1), "32 draws of images and noise"


def tolerance(seed: int) -> ToleranceTable:
    return ToleranceTable.model_validate({"position": "60 nm", "seed": seed})


@pytest.mark.slow
def test_the_cost_of_misalignment_is_that_of_images_with_the_actual_variance() -> None:
    """Against cameras and images drawn at random."""
    camera = replace(derive(described(50.0)), tolerance=tolerance(0))
    assumed, actual = (independent(127.5, variance, 144) for variance in (50.0, ACTUAL))
    matrix = ideal_matrix(camera)
    form = form_of(Problem(matrix, assumed, np.full(camera.measurements, NOISE)))
    used, moments = np.ones(camera.measurements, dtype=np.bool_), misaligned_moments(camera, actual)
    added = float(mismatch_variance(form, used, moments, camera.slices(), actual).mean())
    rng, differences = np.random.default_rng(0), []
    for seed in range(300):
        image = actual.mean + actual.apply_root(rng.standard_normal(144))
        noise = rng.normal(0, NOISE**0.5, camera.measurements) - matrix @ actual.mean
        drawn = replace(camera, tolerance=tolerance(seed))
        estimates = (actual.mean + form.gain(h @ image + noise) for h in (true_matrix(drawn), matrix))
        misaligned, designed = (float(np.square(estimate - image).mean()) for estimate in estimates)
        differences.append(misaligned - designed)
    spread = float(np.std(differences, ddof=1)) / 300**0.5
    assert added == pytest.approx(float(np.mean(differences)), abs=4 * spread)
    assert abs(float(np.mean(differences))) > 5 * spread


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
