"""Windows of further sub-imagers, against every choice of them and against runs."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from ommatid.analysis.predict import predict_scene
from ommatid.analysis.steering import steer, weights_of
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import sets
from ..runs import document

NOISE = 1.0


def tile(side: int, *changes: str) -> Scene:
    return read(GALLERY / "tile19.toml", (f"target.shape=[{side},{side}]", f"noise.variance={NOISE}", *changes))


def error_of(scene: Scene, weights: np.ndarray) -> float:
    """The weighted error by a matrix of all readings of independent pixels."""
    rows, variance = ideal_matrix(derive(scene)).toarray(), scene.prior.variance
    covariance = np.linalg.inv(np.eye(rows.shape[1]) / variance + rows.T @ rows / NOISE)
    return float(weights.ravel() @ np.diag(covariance) / weights.sum())


@pytest.mark.parametrize("prior", ["independent", "exponential"])
def test_the_error_with_the_windows_is_the_predicted_one(prior: str) -> None:
    correlated = ("prior.kind=exponential", "prior.correlation_length=2 mm") if prior == "exponential" else ()
    described = tile(19, "design={windows=3,window=[3,3]}", *correlated)
    steered = steer(described, np.ones((19, 19)))
    assert steered.before == pytest.approx(predict_scene(described, rays=False).mse, rel=1e-9)
    assert steered.errors[-1] == pytest.approx(predict_scene(steered.scene, rays=False).mse, rel=1e-9)
    assert steered.variances[1].mean() == pytest.approx(steered.errors[-1], rel=1e-9)
    assert list(steered.errors) == sorted(steered.errors, reverse=True)


@pytest.mark.parametrize("region", [((0, 0), (9, 9)), ((2, 3), (3, 3)), ((6, 6), (3, 3))])
def test_the_first_window_is_the_best_and_two_are_nearly(region: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """Of all windows of 2 x 2 sensor pixels of two lens types in front of 9 x 9 pixels, and of all pairs of them."""
    halves = "camera.lens.I.magnification=1/2", "camera.lens.I.array=[2,2]"
    changes = *halves, *(f"camera.lens.{name}.pixels=fit" for name in ("I", "II")), "design={windows=2,window=[2,2]}"
    described = read(GALLERY / "tile19.toml", ("target.shape=[9,9]", f"noise.variance={NOISE}", *changes), ("I", "II"))
    weights = weights_of(described, region)
    steered = steer(described, weights)
    own = ideal_matrix(derive(described)).toarray()
    blocks = [
        _window(9, ratio, row, column)
        for ratio in (2, 4)
        for row in range(10 - 2 * ratio)
        for column in range(10 - 2 * ratio)
    ]
    errors: dict[int, list[float]] = {}
    for count in (1, 2):
        for chosen in combinations_with_replacement(blocks, count):
            rows = np.concatenate([own, *chosen])
            covariance = np.linalg.inv(np.eye(81) / described.prior.variance + rows.T @ rows / NOISE)
            errors.setdefault(count, []).append(float(weights.ravel() @ np.diag(covariance) / weights.sum()))
    assert steered.errors[0] == pytest.approx(min(errors[1]), rel=1e-9)
    assert min(errors[2]) * (1 - 1e-9) <= steered.errors[1] <= 1.05 * min(errors[2])
    assert steered.bound <= min(errors[2])


def _window(side: int, ratio: int, row: int, column: int) -> np.ndarray:
    """2 x 2 averages over squares of f."""
    found = np.zeros((4, side, side))
    for number, (down, across) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        first, left = row + ratio * down, column + ratio * across
        found[number, first : first + ratio, left : left + ratio] = ratio**-2.0
    return found.reshape(4, -1)


def test_windows_for_a_region_save_readings() -> None:
    """Four windows of 3 x 3 pixels for a region of 7 x 7 do more than as many spread for all pixels."""
    described = tile(19, "design={windows=4,window=[3,3]}")
    weights = weights_of(described, ((6, 6), (7, 7)))
    near, everywhere = steer(described, weights), steer(described, np.ones((19, 19)))
    assert near.errors[-1] < float((everywhere.variances[1] * weights).sum() / weights.sum())
    assert near.errors[-1] == pytest.approx(error_of(near.scene, weights), rel=1e-9)


def test_the_command_places_windows_for_a_region_and_for_a_run(here: Path, ommatid: Command) -> None:
    options = "--set", "design={windows=2,window=[1,1]}", "--json"
    assert ommatid("run", "tiny.toml", "-o", "out", "-q").code == 0
    for weighted in ("1,1,2,2", "out/tiny"):
        found = document(ommatid("design", "tiny.toml", "--steer", weighted, "-o", "next", *options))
        assert found["bound"] <= found["windows"][-1]["weighted_mse"] < found["before"]
        assert {path.name for path in (here / "next").iterdir()} == {"steered.toml", "steered.png"}
    assert "no choice is better than" in ommatid("design", "tiny.toml", "--steer", "1,1,2,2", *options[:2]).out
    assert ommatid("run", "next/steered.toml", "-o", "steered", "-q").code == 0


REFUSED = {
    "inside the 19 x 19 pixels": (("--steer", "6,6,70,7"), ()),
    "expected the folder of a run": (("--steer", "nothing"), ()),
    "got no place for them": (("--steer", "1,1,2,2"), ("design.window=[9,9]",)),
    "cameras in their places": (("--steer", "1,1,2,2"), ('camera.tolerance={position="1 um"}',)),
    "without surfaces and distortion": (("--steer", "1,1,2,2"), ("camera.lens.I.distortion=[0.01,0]",)),
    "knows noise and prior": (("--steer", "1,1,2,2"), ("estimator.prior_variance=1000",)),
    "set noise.variance": (("--steer", "1,1,2,2"), ("noise=",)),
}


@pytest.mark.parametrize("words", REFUSED)
def test_impossible_windows_are_refused_in_one_sentence(words: str, ommatid: Command) -> None:
    options, changes = REFUSED[words]
    ended = ommatid("design", "tile19", *options, *sets(*changes))
    assert (ended.code, words in ended.err) == (2, True), ended.err
    assert len(ended.err.splitlines()) == 1


def test_windows_whose_patches_overlap_are_refused(here: Path, ommatid: Command) -> None:
    changes = 'camera.lens_pitch="0.03 mm"', "camera.lens.I.pixels=[3,3]", "design.windows=10"
    ended = ommatid("design", "tile19", "--lens", "I", *sets(*changes), "--steer", "0,0,2,19", "-o", "next")
    assert (ended.code, "overlap" in ended.err) == (2, True), ended.err
    assert not (here / "next").exists()


@pytest.mark.parametrize("noise", ["1e-2", "1e-7"])
def test_windows_of_a_nearly_exact_camera_have_the_predicted_error(noise: str) -> None:
    """Where variances are of so different size that an inverse, or a root by Cholesky, would leave no digits."""
    changes = "camera.binning=sum", 'camera.pixel_blur="3 um"', "design={windows=1,window=[2,2]}"
    described = read(GALLERY / "tile19.toml", (f"noise.variance={noise}", *changes))
    steered = steer(described, np.ones((19, 19)))
    assert steered.before == pytest.approx(predict_scene(described, rays=False).mse, rel=1e-6)
    assert 0 < steered.bound <= steered.errors[-1] < steered.before


def test_a_steered_camera_is_steered_again() -> None:
    once = steer(tile(19, "design={windows=1,window=[3,3]}"), np.ones((19, 19)))
    twice = steer(once.scene, np.ones((19, 19)))
    names = [lens.name for lens in twice.scene.camera.lens]
    assert len(set(names)) == len(names) > len(once.scene.camera.lens)
    assert twice.errors[-1] < once.errors[-1]


def test_windows_take_the_same_noise_everywhere(ommatid: Command) -> None:
    ended = ommatid("design", "sensor", "--set", "target.detail=1", "--steer", "1,1,2,2")
    assert (ended.code, "got a [sensor]" in ended.err) == (2, True), ended.err


def test_weights_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="expected weights of 19 x 19"):
        steer(tile(19), np.ones((3, 3)))
