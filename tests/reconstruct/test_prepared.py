"""Frames of one model that share what does not depend on the frame: the results are those of each frame by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from ommatid.reconstruct.estimator import estimate
from ommatid.reconstruct.frame import frame_method
from ommatid.reconstruct.frame.error_map import error_map
from ommatid.reconstruct.methods import dense_method
from ommatid.reconstruct.methods.method import SAME_NOISE, Conditions, Prepared, relative_difference
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import gain_and_error, not_none, slow, with_keys
from ..frames import P0, drawn, precision, recorded, wide

SHAPE = (37, 34)
VARIANCE = 1.0
NOISE = {"noise": {"variance": VARIANCE}}
FRAME = {"method": "frame", "accuracy": 0.01}
METHODS: dict[str, dict[str, Any]] = {"dense": {"method": "auto"}, "frame": FRAME, "tiles": {"method": "tiles"}}


def described(shape: tuple[int, int] = SHAPE, **tables: Any) -> tuple[Scene, Model]:
    given: dict[str, Any] = {**NOISE, "estimator": FRAME, **tables}
    scene = wide(shape, **given)
    return scene, ideal_model(scene, derive(scene))


def frames(scene: Scene, count: int, rendering: float = 0.0) -> list[Stack]:
    """Stacks of different images, with rendering variances that are estimates of `rendering` from 17 passes."""
    shape, variance = derive(scene).shape, VARIANCE if scene.noise is None else scene.noise.variance
    stacks = [recorded(scene, drawn(shape, seed), variance, seed) for seed in range(count)]
    draws = np.random.default_rng(9)
    return [
        replace(stack, rendering_variance=rendering * draws.chisquare(16, stack.values.size) / 16) for stack in stacks
    ]


def assert_same(shared: Reconstruction, alone: Reconstruction) -> None:
    """Everything but the times is the same, bit for bit."""
    np.testing.assert_array_equal(shared.estimate, alone.estimate)
    np.testing.assert_array_equal(shared.expected.variance, alone.expected.variance)
    np.testing.assert_array_equal(shared.expected.resolved, alone.expected.resolved)
    assert shared.budget() == alone.budget()
    assert (shared.solver, shared.residual, shared.interval) == (alone.solver, alone.residual, alone.interval)
    assert (shared.error, shared.verdict) == (alone.error, alone.verdict)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("known", [False, True], ids=["unknown truth", "known truth"])
@pytest.mark.parametrize("noise", [VARIANCE, slow(1e-2)])
def test_frames_of_the_same_noise_are_those_of_single_runs(method: str, known: bool, noise: float) -> None:
    scene, model = described((19, 17), estimator=METHODS[method], noise={"variance": noise})
    prepared = Prepared(model)
    for number, stack in enumerate(frames(scene, 2 if method == "frame" else 3)):
        truth = drawn((19, 17), number) if known else None
        shared = restore(stack, model, truth, prepared=prepared)
        assert_same(shared, restore(stack, model, truth))
        reused = shared.result.noise_difference
        assert reused == (0.0 if number and method != "tiles" else None)


def test_error_bars_and_factorisation_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def counting(name: str, function: Any) -> Any:
        def counted(*arguments: Any, **more: Any) -> Any:
            made.append(name)
            return function(*arguments, **more)

        return counted

    monkeypatch.setattr(frame_method, "error_map", counting("map", error_map))
    monkeypatch.setattr(dense_method, "expected_error", counting("bars", dense_method.expected_error))
    monkeypatch.setattr(estimate, "_factorised", counting("factor", getattr(estimate, "_factorised")))  # noqa: B009
    for method in ("frame", "dense"):
        scene, model = described((19, 17), estimator=METHODS[method])
        prepared = Prepared(model)
        for stack in frames(scene, 3):
            restore(stack, model, prepared=prepared)
    assert made == ["map", "factor", "bars"]


def test_similar_noise_takes_the_error_bars_of_the_first_frame_and_its_own_estimate() -> None:
    """Beside the inverse of the second frame's own precision, whose variances differ from the first's."""
    scene, model = described(prior={"level": "known"})
    first, second = frames(scene, 2, rendering=3e-3 * VARIANCE)
    prepared = Prepared(model)
    bars = restore(first, model, prepared=prepared).expected.variance
    shared, alone = restore(second, model, prepared=prepared), restore(second, model)
    difference = not_none(shared.result.noise_difference)
    assert 0 < difference <= SAME_NOISE
    np.testing.assert_array_equal(shared.expected.variance, bars)
    exact = np.linalg.inv(precision(ideal_matrix(model.camera), 1 / (VARIANCE + second.rendering_variance), 1 / P0))
    assert np.abs(bars / np.diagonal(exact) - 1).max() <= shared.solver.variance_bound
    assert shared.solver.variance_bound == pytest.approx(
        restore(first, model).solver.variance_bound + difference, rel=1e-12
    )
    bound = (shared.solver.bound or 0.0) + (alone.solver.bound or 0.0)
    assert np.abs((shared.estimate - alone.estimate) / np.sqrt(np.diagonal(exact))).max() <= bound


@pytest.mark.parametrize("change", ["noise", "dead pixel", "prior", "rendering"])
def test_other_conditions_compute_the_error_bars_again(change: str) -> None:
    scene, model = described((19, 17))
    first, second = frames(scene, 2)
    prepared = Prepared(model)
    bars = restore(first, model, prepared=prepared).expected.variance
    if change == "rendering":
        second = replace(second, rendering_variance=np.full(second.values.size, 2 * SAME_NOISE * VARIANCE))
    elif change == "dead pixel":
        second = replace(second, values=np.where(np.arange(second.values.size) == 40, np.nan, second.values))
    else:
        variance = {"noise": 2 * VARIANCE, "prior": P0 / 4}[change]
        second = replace(second, scene=with_keys(scene, **{change: {"variance": variance}}))
    shared, alone = restore(second, model, prepared=prepared), restore(second, model)
    assert shared.result.noise_difference is None
    np.testing.assert_allclose(shared.expected.variance, alone.expected.variance, rtol=1e-3)
    assert np.abs(shared.expected.variance / bars - 1).max() > SAME_NOISE / 2
    bound = (shared.solver.bound or 0.0) + (alone.solver.bound or 0.0)
    assert np.abs((shared.estimate - alone.estimate) / np.sqrt(alone.expected.variance)).max() <= bound


@hypothesis.given(st.integers(0, 10**6), st.floats(1e-3, 0.5), st.booleans())
def test_the_difference_of_the_noise_bounds_that_of_the_error(seed: int, scale: float, optimal: bool) -> None:
    """Eq. 5 of random problems, for an estimator that assumes the actual noise or stays with another one."""
    rng = np.random.default_rng(seed)
    h, prior = rng.normal(size=(7, 5)), np.diag(rng.uniform(0.1, 10, 5))
    actual = [rng.uniform(0.1, 10, 7)]
    actual.append(actual[0] * (1 + scale) ** rng.uniform(-1, 1, 7))
    assumed = actual if optimal else [rng.uniform(0.1, 10, 7)] * 2
    errors: list[FloatArray] = []
    for noise, expected in zip(actual, assumed, strict=True):
        errors.append(np.diagonal(gain_and_error(h, prior, expected, actual_noise=noise)[1]))
    conditions = [
        Conditions((), np.ones(7, np.bool_), expected, {"noise": noise / 3, "rendering": noise * 2 / 3})
        for noise, expected in zip(actual, assumed, strict=True)
    ]
    difference = conditions[0].difference(conditions[1])
    assert difference <= scale * (1 + 1e-9)
    assert relative_difference(*errors) <= difference * (1 + 1e-9) + 1e-12


def test_an_estimator_that_changes_and_is_not_optimal_shares_nothing() -> None:
    used, noise = np.ones(4, np.bool_), np.ones(4)
    first, second = (Conditions((), used, assumed * noise, {"noise": noise}) for assumed in (2.0, 2.001))
    assert first.difference(second) == np.inf
    assert first.difference(Conditions((), used, 2.0 * noise, {"noise": 1.01 * noise})) == pytest.approx(0.01)
