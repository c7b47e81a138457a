"""Sub-imagers predicted from all others: against exact arithmetic, over draws of the prior, and with wrong ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
from scipy import special

from ommatid.reconstruct.held_out import block_errors as module
from ommatid.reconstruct.held_out.block_errors import BlockErrors, block_errors
from ommatid.reconstruct.held_out.check import check_held_out, log_survival
from ommatid.reconstruct.misalignment.moments import misaligned_matrix
from ommatid.reconstruct.output.run_json import HeldOutReport
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene, parse, read
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import GALLERY, PAIR, THREE, not_none, scene, slow
from ..frames import P0, recorded, wide

SMALL = (("1/3", [3, 3], [3, 3]), ("1/4", [4, 4], [2, 2]))
NOISE: dict[str, Any] = {"noise": {"variance": 1e-2}}


def blocks_of(camera: Camera) -> list[IntArray]:
    return [np.arange(pixels.start, pixels.stop) for pixels in camera.slices()]


def drawn(problem: Problem, seed: int) -> FloatArray:
    """Measurements of a draw of the prior, with a draw of the noise."""
    rng = np.random.default_rng(seed)
    image = problem.prior.mean + problem.prior.apply_root(rng.normal(size=problem.prior.dimension))
    return problem.matrix @ image + rng.normal(size=problem.measurements) * problem.deviation


def exact_prediction(problem: Problem, values: FloatArray, block: IntArray) -> tuple[FloatArray, FloatArray, float]:
    """Error of the prediction of a block, its precision and its chi-squared, by solving without the block, in 300 bits.

    This is conditioning by definition, and not the identity of the code.
    """
    flint.ctx.prec = 300
    ball: Any = flint.arb_mat
    others = np.setdiff1d(np.arange(problem.measurements), block)
    root = np.diag(problem.prior.root) if problem.prior.independent else problem.prior.root
    signal = ball(problem.matrix.toarray().tolist()) * ball(root.tolist())
    noise = ball(np.diag(problem.noise_variance).tolist())
    covariance = (signal * signal.transpose() + noise).tolist()
    expected = (ball(problem.matrix.toarray().tolist()) * ball(problem.prior.mean[:, None].tolist())).tolist()
    deviation = [[flint.arb(float(value)) - mean] for value, [mean] in zip(values, expected, strict=True)]

    def part(rows: IntArray, columns: IntArray) -> Any:
        return ball([[covariance[row][column] for column in columns] for row in rows])

    gain = part(others, others).solve(part(others, block)).transpose()
    error = ball([deviation[row] for row in block]) - gain * ball([deviation[row] for row in others])
    precision = (part(block, block) - gain * part(others, block)).inv()
    chi_squared = (error.transpose() * precision * error)[0, 0]
    as_array = [np.array([[float(number) for number in row] for row in table.tolist()]) for table in (error, precision)]
    return as_array[0][:, 0], np.diagonal(as_array[1]).copy(), float(chi_squared)


@pytest.mark.parametrize(("noise", "types", "correlated"), [(1e-6, 1, True), slow(1e-6, 2, False), slow(1e-2, 2, True)])
def test_predictions_are_those_of_exact_conditioning(noise: float, types: int, correlated: bool) -> None:
    """To ten digits of each block's largest error."""
    camera = derive(scene((12, 12), SMALL[:types]))
    prior = exponential(127.5, P0, (12, 12), 4.0) if correlated else independent(127.5, P0, 144)
    problem = Problem(ideal_matrix(camera), prior, np.full(camera.measurements, noise))
    values, blocks = drawn(problem, 1), blocks_of(camera)
    predicted = block_errors(problem, values, blocks)
    for index in (0, len(blocks) // 2, len(blocks) - 1):
        error, precision, chi_squared = exact_prediction(problem, values, blocks[index])
        np.testing.assert_allclose(predicted[index].error, error, rtol=0, atol=1e-10 * np.abs(error).max())
        np.testing.assert_allclose(predicted[index].precision, precision, rtol=1e-10)
        assert float(np.sum(predicted[index].whitened ** 2)) == pytest.approx(chi_squared, rel=1e-10)


def test_a_sub_imager_of_one_pixel_errs_by_the_error_of_its_prediction() -> None:
    described = scene((12, 12), (*SMALL[:1], ("1/4", [2, 2], [1, 1])), **NOISE)
    camera = derive(described)
    stack = recorded(described, draw(camera), 1e-2)
    root = np.hstack([P0**0.5 * np.eye(144), np.full((144, 1), described.prior.level_deviation)])
    prior = Prior(np.full(144, 127.5), root)
    problem = Problem(ideal_matrix(camera), prior, np.full(camera.measurements, 1e-2))
    error, precision, _ = exact_prediction(problem, stack.values, blocks_of(camera)[-1])
    entry = check_held_out(stack, ideal_model(described, camera), fitted=False).sub_imagers[-1]
    assert entry.rms_error == pytest.approx(abs(error[0]), rel=1e-8)
    assert entry.expected_rms == pytest.approx(precision[0] ** -0.5, rel=1e-8)


def chi_squared(errors: list[BlockErrors]) -> FloatArray:
    return np.array([float(block.whitened @ block.whitened) for block in errors])


@pytest.mark.parametrize(("noise", "correlated"), [(1e-2, False), slow(1e-6, True)])
def test_two_factorisations_agree_as_stated(noise: float, correlated: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = derive(scene(lenses=THREE))
    prior = exponential(127.5, P0, (19, 19), 25.0) if correlated else independent(127.5, P0, 361)
    problem = Problem(ideal_matrix(camera), prior, np.full(camera.measurements, noise))
    values, blocks = drawn(problem, 2), blocks_of(camera)
    exact = block_errors(problem, values, blocks)
    monkeypatch.setattr(module, "MOST_EXACT", 0)
    for first, second in zip(exact, block_errors(problem, values, blocks), strict=True):
        assert np.linalg.norm(second.whitened) == pytest.approx(np.linalg.norm(first.whitened), abs=module.PRECISION)
        np.testing.assert_allclose(second.precision, first.precision, rtol=module.PRECISION)


def test_probabilities_are_right_beyond_the_range_of_float64() -> None:
    """For 2 a degrees of freedom, a an integer, the tail is exp(-x) times the sum of x^k / k! for k < a."""
    for half, value in [(1, 1.0), (5, 30.0), (12, 2e3), (50, 1e6), (8, 1e8), (3000, 3300.0), (3000, 1e5)]:
        order = np.arange(half)
        terms = order * np.log(value) - special.gammaln(order + 1)
        expected = -value + special.logsumexp(terms)
        assert log_survival(np.array([2 * value]), np.array([2.0 * half]))[0] == pytest.approx(expected, rel=1e-9)


# --- wrong sub-imagers


def moved(camera: Camera, indices: list[int], pixels: float, seed: int = 0) -> Any:
    """H of a camera some of whose sub-imagers see the target `pixels` of f away from where they should."""
    rng = np.random.default_rng(seed)
    table = np.zeros((len(camera.sub_imagers), 6))
    for index in indices:
        direction, depth = rng.uniform(0, 2 * np.pi), camera.sub_imagers[index].depth
        shift = pixels * camera.target_pitch / (1 + camera.distance / depth)  # of the lens
        table[index, :2] = shift * np.cos(direction), shift * np.sin(direction)
    return misaligned_matrix(camera, table)


def draw(camera: Camera, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(127.5, P0**0.5, camera.unknowns)


def checked(described: Scene, matrix: Any, image: FloatArray, *, fitted: bool = False, seed: int = 0) -> HeldOutReport:
    """The check of what a camera with H = `matrix` recorded, by the ideal model."""
    stack = recorded(described, image, not_none(described.noise).variance, seed, matrix)
    return check_held_out(stack, ideal_model(described, stack.camera), fitted=fitted)


def names(check: HeldOutReport) -> list[str]:
    return [entry.name for entry in check.sub_imagers if entry.named]


@pytest.mark.parametrize("index", [20, slow(45)])
def test_a_sub_imager_moved_by_a_twentieth_of_a_pixel_is_the_one_that_is_named(index: int) -> None:
    described = scene(lenses=THREE, noise={"variance": 1e-4})
    camera = derive(described)
    check = checked(described, moved(camera, [index], 0.05, index), draw(camera, index))
    assert names(check) == [camera.sub_imagers[index].name]
    assert not check.verdict.trusted
    assert check.explained
    [wrong] = [entry for entry in check.sub_imagers if entry.named]
    assert not_none(wrong.rms_error) > 2 * not_none(wrong.expected_rms)


def test_several_wrong_sub_imagers_are_named_and_no_other() -> None:
    described = scene(lenses=THREE, **NOISE)
    camera = derive(described)
    wrong = [2, 17, 40]
    check = checked(described, moved(camera, wrong, 0.3), draw(camera))
    assert names(check) == [camera.sub_imagers[index].name for index in wrong]


@pytest.mark.slow
def test_an_h_that_is_a_guess_names_none_but_is_not_to_be_trusted() -> None:
    described = scene(lenses=THREE, **NOISE)
    camera = derive(described)
    check = checked(described, moved(camera, list(range(50)), 0.3), draw(camera))
    assert not check.verdict.trusted
    assert not check.explained
    assert names(check) == []
    assert sum(entry.disagrees for entry in check.sub_imagers) > 40


@pytest.mark.parametrize("name", ["tile19", slow("tile35")])
def test_what_is_right_is_trusted_on_a_photograph(name: str) -> None:
    described = read(GALLERY / f"{name}.toml")
    check = checked(described, None, load(described).ravel(), fitted=name == "tile19")
    assert check.verdict.trusted
    assert not_none(check.p_value) > 1e-4


@pytest.mark.parametrize("noise", [1.0, slow(100.0)])
def test_pictures_of_any_level_are_predicted_as_well_as_stated(noise: float) -> None:
    """Twenty draws of the prior with levels, and a dark and a bright picture by a fitted prior."""
    described = scene(lenses=PAIR, noise={"variance": noise}, prior={"kind": "independent", "variance": 200.0})
    camera, total, freedoms = derive(described), 0.0, 0.0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        drawn_image = rng.normal(127.5, 64.0) + rng.normal(0.0, 200.0**0.5, camera.unknowns)
        check = checked(described, ideal_matrix(camera), drawn_image, seed=seed)
        total += sum(entry.chi_squared for entry in check.sub_imagers)
        freedoms += sum(entry.expected for entry in check.sub_imagers)
        assert check.verdict.trusted
    assert total == pytest.approx(freedoms, rel=0.04)
    for level in (4.0, 250.0):
        flat = np.random.default_rng(0).normal(level, 1.0, camera.unknowns)
        assert checked(described, ideal_matrix(camera), flat, fitted=True).verdict.trusted


# --- frames


def frame() -> tuple[Scene, Camera]:
    described = wide((47, 50), **NOISE, calibration={"method": "ideal"})
    return described, derive(described)


def test_a_frame_is_checked_in_windows_stored_or_not() -> None:
    described, camera = frame()
    image = draw(camera)
    stack = recorded(described, image, 1e-2)
    model = ideal_model(described, camera)
    check = check_held_out(stack, model, fitted=False)
    assert (check.windows.checked, check.windows.total) == (4, 4)
    assert check.verdict.trusted
    used = sum(entry.pixels for entry in check.sub_imagers)
    assert used > 0.7 * camera.measurements
    total = sum(entry.chi_squared for entry in check.sub_imagers)
    # Errors of different sub-imagers are correlated, so the variance of their sum is at most 50 times their variances.
    assert total == pytest.approx(used, abs=4 * (50 * 2 * used) ** 0.5)
    unstored = replace(model, stored=None, variance=np.zeros(0), batches=np.zeros((0, 0), np.float32))
    again = check_held_out(stack, unstored, fitted=False)
    assert [entry.chi_squared for entry in again.sub_imagers] == pytest.approx(
        [entry.chi_squared for entry in check.sub_imagers], rel=1e-6
    )


# --- edges of the domain


def test_dead_pixels_and_a_dead_sub_imager_are_left_out() -> None:
    described = scene(lenses=THREE, **NOISE)
    camera = derive(described)
    stack = recorded(described, draw(camera), 1e-2)
    values = stack.values.copy()
    values[camera.slices()[4]] = np.nan
    values[3] = np.nan
    check = check_held_out(replace(stack, values=values), ideal_model(described, camera), fitted=False)
    assert check.verdict.trusted
    pixels = [entry.pixels for entry in check.sub_imagers]
    assert (pixels[0], pixels[4], pixels[5]) == (24, 0, 25)
    assert check.sub_imagers[4].z is None


def test_a_single_sub_imager_has_no_others() -> None:
    described = scene((12, 12), (("1", [1, 1], [12, 12]),), **NOISE)
    check = checked(described, None, draw(derive(described)))
    assert check.p_value is None
    assert check.verdict.trusted is None


def test_without_noise_there_is_nothing_to_compare_with() -> None:
    described = scene((12, 12), SMALL, calibration={"method": "ideal"})
    stack = recorded(described, draw(derive(described)), 0.0)
    with pytest.raises(InputError, match="without noise has nothing to be compared with"):
        check_held_out(stack, ideal_model(described, stack.camera))


def tolerant(method: str) -> tuple[Scene, Stack]:
    tables: dict[str, Any] = {"estimator": {"misalignment": method}, "calibration": {"method": "ideal"}}
    data = scene(lenses=THREE, **NOISE, **tables).plain()
    data["camera"]["tolerance"] = {"position": "41 nm"}
    described = parse(data, Path("test.toml"))
    camera = derive(described)
    wrong = moved(camera, list(range(50)), 0.03)
    return described, recorded(described, draw(camera), 1e-2, matrix=wrong)


def test_a_misaligned_camera_contradicts_itself_and_a_fitted_one_holds_nothing_out() -> None:
    described, stack = tolerant("trust")
    assert check_held_out(stack, ideal_model(described, stack.camera), fitted=False).verdict.trusted is False
    described, stack = tolerant("fit")
    with pytest.raises(InputError, match="none is held out"):
        check_held_out(stack, ideal_model(described, stack.camera))
