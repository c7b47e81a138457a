"""A whole frame beside the dense estimate of the same: image, error bars, where the error comes from, and sums."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.reconstruct.method_choice import METHODS, choose_method
from ommatid.reconstruct.prediction import predict_frame
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from ..frames import FITTED, P0, blurred, recorded, wide

ROOT = Path(__file__).parents[2]
SHAPE = (52, 47)
NOISE = {"variance": 1e-2, "bits": 10}
VARIANCE = 1e-2 + (256 / 2**10) ** 2 / 12


def both(one: Scene, stack: Stack, model: Model, truth: Any) -> tuple[Reconstruction, Reconstruction]:
    """The dense estimate, and that of the whole frame to 1e-6."""
    found: list[Reconstruction] = []
    for method in ("information", "frame"):
        told = one.estimator.model_copy(update={"method": method, "accuracy": 1e-6})
        found.append(restore(replace(stack, scene=one.model_copy(update={"estimator": told})), model, truth))
    assert found[1].solver.method == "frame"
    return found[0], found[1]


def drawn(seed: int = 0, shape: tuple[int, int] = SHAPE) -> Any:
    return 127.5 + np.random.default_rng(seed).normal(0, P0**0.5, shape[0] * shape[1])


CASES = {
    "perfect": ({"noise": NOISE}, 0.0),
    "told another noise": ({"noise": NOISE, "estimator": {"noise_variance": 1.0}}, 0.0),
    "uncertain H": ({"noise": NOISE}, 0.003),
    "uncertain H, told another noise": ({"noise": NOISE, "estimator": {"noise_variance": 0.1}}, 0.003),
}


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_dense_estimate_with_the_same_error_bars(case: str) -> None:
    tables, spread = CASES[case]
    one, truth = wide(SHAPE, FITTED, **tables), drawn()
    model, true = blurred(one, spread) if spread else (ideal_model(one, derive(one)), None)
    stack = recorded(one, truth, VARIANCE, matrix=true)
    dense, frame = both(one, stack, model, truth)
    deviation = np.sqrt(dense.expected.variance)
    assert np.abs((frame.estimate - dense.estimate) / deviation).max() < 1e-4
    stated = 1e-2 if case == "told another noise" else 1e-3  # much expected noise joins pixels farther apart
    np.testing.assert_allclose(frame.expected.variance, dense.expected.variance, rtol=stated)
    np.testing.assert_allclose(frame.expected.resolved, dense.expected.resolved, atol=2e-3)
    assert frame.solver.variance_bound < stated
    assert frame.residual is not None
    assert dense.residual is not None
    assert frame.residual.chi_squared == pytest.approx(dense.residual.chi_squared, rel=1e-4)
    assert sum(frame.budget().values()) == pytest.approx(frame.expected.mse)
    assert frame.budget()["null_space"] == pytest.approx(dense.budget()["null_space"], rel=1e-3)
    for name, part in dense.budget().items():  # shares from images of chance: their squares scatter
        assert frame.budget()[name] == pytest.approx(part, rel=0.35), name
    assert frame.interval is not None
    assert dense.interval is not None
    assert frame.interval.mse == pytest.approx(dense.interval.mse, rel=0.03)
    mean, width = dense.interval.mse, dense.interval.high - dense.interval.low
    assert abs(frame.interval.mse - mean) < width
    assert 0.7 * width < frame.interval.high - frame.interval.low < 1.6 * width
    some, every = frame.region((8, 9), (6, 20)), dense.region((8, 9), (6, 20))
    assert some == pytest.approx(every, rel=1e-4)


def test_its_parts_are_right_on_average(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over many images of chance the parts of the error are those of the dense answer."""
    one, truth = wide(SHAPE, noise=NOISE), drawn()
    stack = recorded(one, truth, VARIANCE)
    stack = replace(stack, variance=1e-3 * np.random.default_rng(1).uniform(1, 3, stack.values.size))
    model = ideal_model(one, derive(one))
    dense, _ = both(one, stack, model, truth)
    told = one.estimator.model_copy(update={"method": "frame"})
    found: list[dict[str, float]] = []
    for seed in range(12):
        monkeypatch.setattr("ommatid.reconstruct.frame.frame_method.SEED", seed)
        found.append(restore(replace(stack, scene=one.model_copy(update={"estimator": told})), model).budget())
    for name in ("noise", "rendering"):
        values = [budget[name] for budget in found]
        assert np.mean(values) == pytest.approx(dense.budget()[name], abs=4 * float(np.std(values)) / 12**0.5)


def test_dead_and_saturated_pixels() -> None:
    one, truth = wide(SHAPE, noise={"variance": 1e-2, "saturation": 180.0}), drawn(2)
    stack = recorded(one, truth, 1e-2)
    values = np.minimum(stack.values, 180.0)
    values[::97] = np.nan
    dense, frame = both(one, replace(stack, values=values), ideal_model(one, stack.camera), truth)
    assert frame.usable.dead == dense.usable.dead > 0
    assert frame.usable.saturated == dense.usable.saturated > 0
    deviation = np.sqrt(dense.expected.variance)
    assert np.abs((frame.estimate - dense.estimate) / deviation).max() < 1e-4
    np.testing.assert_allclose(frame.expected.variance, dense.expected.variance, rtol=2e-3)


def test_a_prior_whose_pixels_go_together() -> None:
    """Inside, the prior is the dense one's; within a correlation length of the edge it is reflected there."""
    shape = (42, 37)
    prior = {"kind": "exponential", "variance": 2000.0, "correlation_length": "4 mm"}
    one = wide(shape, noise={"variance": 1.0}, prior=prior)
    truth = drawn(3, shape)
    dense, frame = both(one, recorded(one, truth, 1.0), ideal_model(one, derive(one)), truth)
    deviation = np.sqrt(dense.expected.variance)
    away = ((frame.estimate - dense.estimate) / deviation).reshape(shape)
    assert np.abs(away[12:-12, 12:-12]).max() < 0.05
    assert np.abs(away).max() < 1.5
    inner = (frame.expected.variance / dense.expected.variance - 1).reshape(shape)[12:-12, 12:-12]
    assert np.abs(inner).max() < 0.01


def test_a_fitted_prior_on_a_frame() -> None:
    """A smooth image and much noise: less error than with the paper's prior, and as much as expected."""
    rough = np.random.default_rng(0).normal(size=SHAPE)
    smooth = sum(np.roll(rough, (i, j), (0, 1)) for i in range(-3, 4) for j in range(-3, 4)) * 6
    truth = 127.5 + np.asarray(smooth).ravel()
    found: list[Reconstruction] = []
    for kind in ("independent", "fit"):
        one = wide(SHAPE, noise={"variance": 4.0}, prior={"kind": kind}, estimator={"method": "frame"})
        found.append(restore(recorded(one, truth, 4.0), ideal_model(one, derive(one)), truth))
    paper, fitted = found
    assert fitted.fit is not None
    assert not fitted.fit.doubtful
    assert fitted.error is not None
    assert paper.error is not None
    assert fitted.error.mse < 0.2 * paper.error.mse
    assert fitted.interval is not None
    assert fitted.interval.low < fitted.error.mse < fitted.interval.high


def test_a_prediction_of_a_frame_is_that_of_the_dense_problem() -> None:
    one = wide(SHAPE, noise={"variance": 1e-2}, estimator={"method": "frame"})
    camera = derive(one)
    found = predict_frame(choose_method(one, camera, exact=True), ideal_model(one, camera), 1e-2)
    stack = recorded(one, drawn(), 1e-2)
    dense, _ = both(one, stack, ideal_model(one, camera), None)
    assert found.mse == pytest.approx(dense.expected.mse, rel=1e-3)
    assert found.trimmed_mse == pytest.approx(dense.trimmed_mse, rel=1e-3)
    assert found.degrees_of_freedom == pytest.approx(dense.expected.degrees_of_freedom, rel=1e-6)
    assert (found.rank, found.null_space, found.condition) == (None, None, None)


def test_a_prediction_without_any_noise_that_is_expected_all_the_same() -> None:
    one = wide(SHAPE, noise={"variance": 0.0}, estimator={"method": "frame", "noise_variance": 1e-2})
    camera = derive(one)
    found = predict_frame(choose_method(one, camera, exact=True), ideal_model(one, camera), 0.0)
    told = replace(recorded(one, drawn(), 0.0), scene=one.model_copy(update={"noise": None}))
    dense, _ = both(one, told, ideal_model(one, camera), None)
    assert found.mse == pytest.approx(dense.expected.mse, rel=1e-3)
    assert dense.budget()["noise"] == 0


def test_the_program_stays_within_the_memory_that_it_says() -> None:
    """What a frame took at most, in a process of its own, against what is compared with `estimator.memory`.

    From /proc, since what getrusage says of a process includes the peak of the one that started it.
    """
    if not Path("/proc/self/status").is_file():
        pytest.skip("the system does not tell")
    script = (
        "from tests.reconstruct.test_frame_method import *\n"
        "shape = (420, 400); one = wide(shape, noise=NOISE); truth = drawn(0, shape)\n"
        "camera = derive(one); stack = recorded(one, truth, VARIANCE)\n"
        "allowed = choose_method(one, camera, exact=True).memory\n"
        "restore(stack, ideal_model(one, camera), truth)\n"
        "status = Path('/proc/self/status').read_text().split()\n"
        "print(allowed, 1024 * int(status[status.index('VmHWM:') + 1]))"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    said, taken = map(int, ended.stdout.split())
    stored = 2 * 12 * 50 * 420 * 400  # H as the data were made from it, and as the model holds it
    assert taken <= said + stored


@pytest.mark.parametrize(
    ("tables", "lenses", "message"),
    [
        ({"noise": {"variance": 0.0}}, FITTED, "needs noise in every measurement"),
        ({"noise": NOISE}, (("1/3", [2, 3], "fit"),), "lens type 'A' is no array of m x m sub-imagers with step 1"),
    ],
)
def test_what_it_cannot_do_it_refuses(tables: dict[str, Any], lenses: Any, message: str) -> None:
    one = wide(SHAPE, lenses, **tables, estimator={"method": "frame"})
    stack = recorded(one, drawn(), 0.0)
    with pytest.raises(InputError, match=message):
        restore(stack, ideal_model(one, stack.camera))


@pytest.mark.parametrize(
    ("shape", "lenses", "tables", "way"),
    [
        ((59, 59), FITTED, {"noise": NOISE}, "dense"),
        ((239, 239), FITTED, {"noise": NOISE}, "frame"),
        ((239, 239), FITTED, {"noise": NOISE, "estimator": {"accuracy": 0.5}}, "tiles"),
        ((239, 239), FITTED, {}, "tiles"),
        ((239, 239), (("1/3", [2, 3], "fit"),), {"noise": NOISE}, "tiles"),
        ((239, 239), FITTED, {"noise": NOISE, "estimator": {"method": "tiles"}}, "tiles"),
        ((59, 59), FITTED, {"noise": NOISE, "estimator": {"method": "frame"}}, "frame"),
        ((59, 59), FITTED, {"noise": NOISE, "estimator": {"memory": "650 MB"}}, "tiles"),
    ],
)
def test_which_way_is_chosen(shape: tuple[int, int], lenses: Any, tables: dict[str, Any], way: str) -> None:
    one = wide(shape, lenses, **tables)
    chosen = choose_method(one, derive(one), exact=True)
    assert chosen.method == way
    assert chosen.method in METHODS
    assert chosen.memory <= 650e6 or one.estimator.memory is None


def test_no_way_fits_into_memory() -> None:
    one = wide((239, 239), noise=NOISE, estimator={"memory": "1 MB"})
    with pytest.raises(InputError, match=r"estimator needs .* GB .*0\.0 GB are allowed; raise estimator\.memory"):
        choose_method(one, derive(one), exact=True)
