"""Worlds finer than f: estimates and error bars against a second method, the estimate of the world itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from ommatid.reconstruct.coarse_model import CoarseModel, model_of_f, repetition
from ommatid.reconstruct.frame import reading_space
from ommatid.reconstruct.held_out.check import check_held_out
from ommatid.reconstruct.prior import coloured, prior_of, spectrum_of
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.errors import InputError
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import exact_model, ideal_matrix, ideal_model, true_matrix
from ommatid.simulate.render import exposed
from tests.examples import (
    THREE,
    covariance_of,
    gain_and_error,
    inside_interval,
    not_none,
    scene,
    slow,
    with_keys,
    with_optics,
)

Array = NDArray[np.float64]

NOISE = 0.5
EXPONENTIAL = {"level": "known", "kind": "exponential", "correlation_length": "6 mm", "variance": 900.0}
IDEAL = {"method": "ideal"}
CAMERAS = {
    "distorted": ({"distortion": [0.3, 0]}, {"lens_pitch": "3 mm"}),
    "misaligned": ({}, {"tolerance": {"position": "0.5 um"}}),
    "out of focus": ({"aperture": "0.8 mm", "focus": "800 mm"}, {"lens_pitch": "1 mm"}),
}
FEW = ["misaligned", *(slow(kind) for kind in ("distorted", "out of focus"))]
SMALL = (("1/3", [3, 3], [3, 3]), ("1/2", [2, 2], [5, 5]))


@dataclass(frozen=True)
class Case:
    """A small camera in front of a world twice as fine as f, its true H, and the dense matrices of the problem."""

    setup: Setup
    model: Model
    covariance: Array
    averages: Array

    @property
    def scene(self) -> Scene:
        return self.setup.scene

    def recorded(self, world: Array, seed: int) -> Stack:
        """The noisy measurements of a world."""
        setup = replace(self.setup, scene=with_keys(self.scene, render={"seed": seed}))
        return exposed(setup, self.model.forward(world), np.zeros(self.model.measurements), {})

    def restored(self, world: Array, seed: int) -> Reconstruction:
        """The estimate from these measurements."""
        return restore(self.recorded(world, seed), self.model, world)


@cache
def case(kind: str, prior_kind: str = "exponential") -> Case:
    lens, camera_table = CAMERAS[kind]
    prior = EXPONENTIAL if prior_kind == "exponential" else {"kind": prior_kind, "level": "known"}
    tables = {"prior": prior, "noise": {"variance": NOISE}, "calibration": IDEAL, "target": {"detail": 2}}
    described, _ = with_optics(lens, camera_table, SMALL, (11, 11), **tables)
    setup = Setup.from_scene(described)
    camera = setup.calibrated.camera
    model = exact_model(setup.resolved, camera, true_matrix(camera), "true")
    covariance = np.zeros((0, 0))
    if prior_kind == "exponential":
        covariance = covariance_of(prior_of(described.prior, camera.shape, camera.target_pitch))
    return Case(setup, model, covariance, repetition((11, 11), 2).T.toarray() / 4)


def drawn(case: Case, seed: int) -> Array:
    """A world drawn from the prior."""
    root = np.linalg.cholesky(case.covariance)
    return 127.5 + root @ np.random.default_rng(seed).normal(size=len(root))


@pytest.mark.parametrize("kind", FEW)
def test_the_estimate_is_the_average_of_the_estimated_world(kind: str) -> None:
    """The world is estimated on its own grid (Wood et al., Eq. 4), and averaged: the same image, the same variance."""
    shown = case(kind)
    world = drawn(shown, 1)
    result = shown.restored(world, 3)
    matrix, average, prior = shown.model.matrix.toarray(), shown.averages, shown.covariance
    recorded = shown.recorded(world, 3).values
    gain, posterior = gain_and_error(matrix, prior, NOISE)
    estimated = 127.5 + gain @ (recorded - matrix @ np.full(len(prior), 127.5))
    np.testing.assert_allclose(result.estimate, average @ estimated, rtol=1e-7)
    np.testing.assert_allclose(result.expected.variance, np.diagonal(average @ posterior @ average.T), rtol=1e-6)
    bias = average @ (gain @ matrix @ (world - 127.5) - (world - 127.5))
    noise = NOISE * average @ gain @ gain.T @ average.T
    interval = not_none(result.interval)
    assert interval.mse == pytest.approx(np.mean(np.square(bias) + np.diagonal(noise)), rel=1e-6)
    spread = 2 * np.square(noise).sum() + 4 * bias @ noise @ bias
    assert interval.variance == pytest.approx(spread / bias.size**2, rel=0.2)
    assert sum(result.budget().values()) == pytest.approx(result.expected.mse)
    assert result.budget()["detail"] > 0


@pytest.mark.slow
def test_the_image_alone_gives_an_interval_that_allows_for_any_detail() -> None:
    shown = case("distorted")
    inside = 0
    for seed in range(20):
        world = drawn(shown, seed)
        result = restore(shown.recorded(world, seed), shown.model, shown.averages @ world)
        inside += inside_interval(result)
    assert inside >= 18


@pytest.mark.parametrize("kind", FEW)
def test_a_frame_estimates_the_world_and_averages_it(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the covariance of the readings: the same estimate, error bars, sums of pixels and interval."""
    shown = case(kind)
    world = drawn(shown, 1)
    exact = shown.restored(world, 3)
    monkeypatch.setattr(reading_space, "MOST_READINGS", 0)
    frame = shown.restored(world, 3)
    assert exact.solver.refinements < 4 < frame.solver.refinements
    deviation = np.sqrt(exact.expected.variance)
    assert np.abs((frame.estimate - exact.estimate) / deviation).max() < 0.01
    np.testing.assert_allclose(frame.expected.variance, exact.expected.variance, rtol=1e-6)
    assert sum(frame.budget().values()) == pytest.approx(frame.expected.mse)
    assert frame.budget()["detail"] == pytest.approx(exact.budget()["detail"], rel=0.5)  # by one draw
    assert not_none(frame.interval).mse == pytest.approx(not_none(exact.interval).mse, rel=0.01)
    assert not_none(frame.interval).high == pytest.approx(not_none(exact.interval).high, rel=0.1)
    assert frame.region((3, 4), (5, 5))[1] == pytest.approx(exact.region((3, 4), (5, 5))[1], rel=1e-3)
    assert frame.verdict.trusted
    known = shown.averages @ world
    of_f = restore(shown.recorded(world, 3), shown.model, known)  # the world's detail is then one of many
    assert not_none(of_f.interval).mse == pytest.approx(exact.expected.mse, rel=0.4)


def test_noise_far_below_the_detail_takes_no_digits() -> None:
    """At a noise variance of 1e-10 the error is that of detail and null space, as at 1e-4."""
    shown = case("misaligned")
    world = drawn(shown, 1)
    found: list[Reconstruction] = []
    for noise in (1e-4, 1e-10):
        stack = shown.recorded(world, 3)
        scene = with_keys(stack.scene, estimator={"noise_variance": noise})
        found.append(restore(replace(stack, scene=scene), shown.model, world))
    first, second = (each.expected.missing + each.expected.parts["detail"] for each in found)
    assert second == pytest.approx(first, rel=1e-2)
    assert not_none(found[1].solver.bound) <= 0.01
    assert found[1].solver.variance_bound < 0.05


@pytest.mark.slow
def test_errors_of_entries_attenuate_a_finer_world() -> None:
    """H from eight noisy batches, 20 draws: what is expected of the world errs by a fifth at most, on the safe side."""
    shown, count = case("distorted"), 8
    right = shown.model.matrix
    ratios: list[float] = []
    shares: list[float] = []
    for seed in range(20):
        world = drawn(shown, seed)
        errors = np.random.default_rng(seed).normal(size=(count, right.nnz)) * 0.2 * np.sqrt(right.data)
        errors -= (np.add.reduceat(errors, right.indptr[:-1], axis=1) / np.diff(right.indptr)).repeat(
            np.diff(right.indptr), axis=1
        )
        mean = errors.mean(axis=0)
        stored = sparse.csr_array((right.data + mean, right.indices, right.indptr), shape=right.shape)
        variance = np.square(errors - mean).sum(axis=0) / (count * (count - 1))
        batches = np.asarray(errors - mean, dtype=np.float32)
        record = {**shown.model.record, "method": "transport"}
        noisy = replace(shown.model, stored=stored, variance=variance, batches=batches, record=record)
        result = restore(shown.recorded(world, seed), noisy, world)
        ratios.append(not_none(result.error).mse / not_none(result.interval).mse)
        shares.append(not_none(result.expected.attenuation) / result.expected.mse)
        assert result.verdict.level == "green"
    assert np.mean(shares) > 0.05
    assert 0.8 < np.mean(ratios) < 1 + 3 * float(np.std(ratios, ddof=1)) / 20**0.5


@cache
def blurred(prior_kind: str) -> tuple[Setup, Model]:
    """Apertures whose Airy patterns are wider than the target, before a world three times finer, without entries."""
    prior = EXPONENTIAL if prior_kind == "exponential" else {"kind": prior_kind}
    tables = {"prior": prior, "noise": {"variance": 1e-2}, "calibration": IDEAL, "target": {"detail": 3}}
    lenses = (("1/3", [3, 3], [7, 7]), ("1/2", [2, 2], [11, 11]))
    described, _ = with_optics({"aperture": "0.4 mm"}, {"lens_pitch": "1 mm"}, lenses, (24, 24), **tables)
    setup = Setup.from_scene(described)
    model = ideal_model(setup.resolved, setup.calibrated.camera)
    assert model.stored is None
    return setup, model


def test_few_pixels_in_front_of_a_large_world_are_a_dense_problem() -> None:
    """Where pixels are independent, f's own H has entries although that of the world has none."""
    setup, model = blurred("independent")
    coarse = model_of_f(model, setup.camera, setup.scene.prior)
    expected = model.observation.to_sparse() @ repetition((24, 24), 3)
    np.testing.assert_allclose(coarse.matrix.toarray(), expected.toarray(), atol=1e-12)


def test_a_prior_is_fitted_behind_kernels_wider_than_the_target() -> None:
    """No measurement sees a window alone: those of its middle do, with their light from beside it as noise."""
    setup, model = blurred("fit")
    table = with_keys(setup.scene, prior={"kind": "exponential", "correlation_length": 6.0, "variance": 900.0}).prior
    white = np.random.default_rng(1).normal(size=(72, 72))
    world = coloured(spectrum_of(table, (72, 72), 1 / 3), white).ravel() + 127.5
    stack = exposed(setup, model.forward(world), np.zeros(model.measurements), {})
    result = restore(stack, model, world)
    assert result.choice.method == "frame"
    assert not not_none(result.fit).doubtful
    found, deviation = not_none(result.fit).numbers["variance"]
    assert abs(np.log(found / 900.0)) < 4 * deviation


def test_a_camera_of_whole_pixels_has_no_detail() -> None:
    """The paper's H takes averages of f's pixels from any world, so nothing is computed on the world's grid."""
    setup = Setup.from_scene(scene(lenses=THREE, prior=EXPONENTIAL, calibration=IDEAL, target={"detail": 3}))
    assert not setup.camera.has_detail
    assert setup.calibrated.camera.unknowns == 361
    assert [each.why for each in setup.skipped if each.what == "detail"] == [
        "every sensor pixel covers whole pixels of f"
    ]
    left = ideal_matrix(setup.world.camera) - ideal_matrix(setup.camera) @ (repetition((19, 19), 3).T / 9)
    assert np.abs(left.toarray()).max() < 1e-9


def test_independent_pixels_say_nothing_of_detail() -> None:
    shown = case("distorted", "independent")
    coarse = model_of_f(shown.model, shown.setup.camera, shown.scene.prior)
    assert isinstance(coarse, CoarseModel)
    np.testing.assert_allclose(
        coarse.matrix.toarray(), ideal_matrix(replace(shown.setup.camera, detail=1)).toarray(), atol=1e-7
    )
    image = np.random.default_rng(0).uniform(0, 255, 121)
    result = shown.restored(repetition((11, 11), 2) @ image, 4)
    assert inside_interval(result)


def test_the_prior_of_f_is_that_of_averages() -> None:
    table = case("distorted").scene.prior
    expected = case("distorted").averages @ case("distorted").covariance @ case("distorted").averages.T
    np.testing.assert_allclose(covariance_of(prior_of(table, (11, 11), 1.0, 2)), expected, atol=1e-8)


@pytest.mark.slow
def test_a_prior_is_fitted_to_the_world() -> None:
    shown, fitted = case("distorted"), case("distorted", "fit")
    ratios: list[float] = []
    for seed in range(20):
        result = fitted.restored(drawn(shown, seed), seed)
        assert not not_none(result.fit).doubtful
        ratios.append(not_none(result.error).mse / result.expected.mse)
    assert np.mean(ratios) == pytest.approx(1, abs=0.1 + 3 * float(np.std(ratios, ddof=1)) / 20**0.5)


def test_a_fitted_misalignment_takes_a_world_of_pixels() -> None:
    shown = case("misaligned")
    setup = replace(shown.setup, scene=with_keys(shown.scene, estimator={"misalignment": "fit"}))
    model = ideal_model(setup.resolved, setup.calibrated.camera)
    stack = exposed(setup, model.forward(drawn(shown, 1)), np.zeros(model.measurements), {})
    with pytest.raises(InputError, match=r"takes a world made of f's pixels, got target.detail 2"):
        restore(stack, model)


@pytest.mark.parametrize("level", [0.0, 64.0])
def test_held_out_errors_are_those_of_the_world(level: float) -> None:
    """Predictions of a sub-imager from the others, with the covariance of the world itself, by the normal equations."""
    shown = case("distorted")
    world = drawn(shown, 7) - level
    stack = shown.recorded(world, 7)
    known = replace(stack, scene=with_keys(stack.scene, prior={"level": level or "known"}))
    checked = check_held_out(known, shown.model)
    matrix = shown.model.matrix.toarray()
    covariance = matrix @ (shown.covariance + level**2) @ matrix.T + NOISE * np.eye(len(matrix))
    residual = stack.values - matrix @ np.full(len(world), 127.5)
    for sub, rows in zip(checked.sub_imagers, shown.setup.camera.slices(), strict=True):
        block, others = np.arange(len(matrix))[rows], np.delete(np.arange(len(matrix)), rows)
        gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[np.ix_(others, block)]).T
        error = residual[block] - gain @ residual[others]
        spread = covariance[np.ix_(block, block)] - gain @ covariance[np.ix_(others, block)]
        assert sub.chi_squared == pytest.approx(error @ np.linalg.solve(spread, error), rel=1e-6)
    assert checked.verdict.trusted
