"""Errors of few numbers of H: their part of Eq. 5, of the interval, of sums of pixels and of the residual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy import sparse

from ommatid.reconstruct.assumptions import Assumptions, assumptions_for
from ommatid.reconstruct.frame import frame_method
from ommatid.reconstruct.held_out.check import check_held_out
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.methods.method import Execution, MethodResult, PosteriorOperators
from ommatid.reconstruct.model_error import shared_errors as module
from ommatid.reconstruct.model_error.shared_errors import shared_errors
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.reconstruct.verdict.residual import WhitenedResidual, residual_parts, squared_trace
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.fitted.fitted_matrix import Directions
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import Model
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from tests.examples import THREE, not_none, scene, slow, with_keys

SHAPE = (19, 19)
NOISE = 1e-2
SHIFT = 0.01  # pixels of f, deviation of a view's position
COMBINATIONS = 64


def slope(axis: int, shape: tuple[int, int]) -> sparse.csr_array:
    """Derivative of an image along an axis by central differences: (N, N)."""
    steps = [sparse.csr_array(sparse.eye_array(size)) for size in shape]
    rows = np.arange(1, shape[axis] - 1)
    ones = np.full(rows.size, 0.5)
    size = (shape[axis], shape[axis])
    steps[axis] = sparse.csr_array(sparse.coo_array((ones, (rows, rows + 1)), size)) - sparse.csr_array(
        sparse.coo_array((ones, (rows, rows - 1)), size)
    )
    return sparse.csr_array(sparse.kron(*steps, format="csr"))


@dataclass(frozen=True)
class ShiftedModel(Model):
    """H whose every sub-imager has a view that is off by an unknown shift, down and across."""

    shift: float = SHIFT

    def changes(self, image: FloatArray) -> list[FloatArray]:
        """Change of H f by a deviation of the shift down and across: (M,) each."""
        shape = self.camera.world.shape if image.size != self.unknowns else self.camera.shape
        return [self.shift * (self.matrix @ (slope(axis, shape) @ image)) for axis in (0, 1)]

    def errors(self, image: FloatArray) -> Directions:
        """A column for each shift, with entries in the rows of its sub-imager alone."""
        changes = self.changes(image.ravel())
        blocks = [(part, np.column_stack([change[part] for change in changes])) for part in self.camera.slices()]
        return Directions(self.measurements, lambda: ((part, sparse.csc_array(block)) for part, block in blocks))


@cache
def case(kind: str = "independent", shift: float = SHIFT, detail: int = 1) -> tuple[Stack, ShiftedModel, FloatArray]:
    """A stack without values, the model that its estimator is given, and the picture on that model's grid."""
    prior = {"kind": kind} | ({"correlation_length": "10 mm"} if kind == "exponential" else {})
    # Footprints of 3.5 pixels show detail.
    lenses = THREE if detail == 1 else (("2/7", [3, 3], [4, 4]), *THREE[1:])
    described = scene(SHAPE, lenses, noise={"variance": NOISE}, prior=prior, target={"detail": detail})
    setup = Setup.from_scene(described)
    camera = setup.calibrated.camera
    exact = ideal_model(described, camera)
    matrix = ideal_matrix(camera)
    model = ShiftedModel(
        described,
        camera,
        matrix,
        np.zeros(matrix.nnz),
        np.zeros((0, matrix.nnz), np.float32),
        {**exact.record, "method": "transport"},
        shift=shift,
    )
    zero = np.zeros(camera.measurements)
    return Stack(described, setup.camera, zero, zero, {}), model, setup.calibrated.image.ravel()


def recorded(stack: Stack, model: ShiftedModel, image: FloatArray, rng: np.random.Generator) -> Stack:
    """The stack of an image by a camera whose views are off by a draw of the shifts."""
    directions = model.errors(image).matrix
    error = directions @ rng.normal(size=directions.shape[1])
    values = model.forward(image) + error + NOISE**0.5 * rng.normal(size=model.measurements)
    return replace(stack, values=values)


def restored(kind: str, seed: int, image: FloatArray | None = None, shift: float = SHIFT) -> Reconstruction:
    stack, model, picture = case(kind, shift)
    image = picture if image is None else image
    return restore(recorded(stack, model, image, np.random.default_rng(seed)), model, image)


@cache
def prepared(kind: str, detail: int = 1) -> tuple[Assumptions, MethodResult]:
    """Assumptions and result of one recording, whose estimator then serves many others."""
    stack, model, picture = case(kind, detail=detail)
    stack = recorded(stack, model, picture, np.random.default_rng(0))
    choice = choose_method(stack.scene, stack.camera, exact=False)
    assumed = assumptions_for(stack, model, choice, Execution())
    return assumed, assumed.result(picture)


def operators_of(assumed: Assumptions) -> PosteriorOperators:
    return not_none(assumed.method.operators())


def error_of(kind: str, detail: int = 1) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Bias of the estimate of the picture, (N,), and what it makes of unit deviates of shifts, and of noise: (N, k)."""
    (assumed, _), (_, model, world) = prepared(kind, detail), case(kind, detail=detail)
    task, operators, mean = assumed.method.task, operators_of(assumed), assumed.prior.mean

    def estimated(readings: FloatArray) -> FloatArray:
        return np.stack([task.of_f(operators.gain(each)) for each in readings.T], axis=1)

    truth = averaged(world.reshape(model.camera.shape), detail).ravel() if detail > 1 else world
    bias = estimated(model.forward(world - mean)[:, None])[:, 0] - (truth - mean)
    shifts = estimated(model.errors(world).matrix.toarray())
    return bias, shifts, NOISE**0.5 * estimated(np.eye(model.measurements))


@pytest.mark.parametrize(("kind", "detail"), [("independent", 1), *(slow("exponential", detail) for detail in (1, 2))])
def test_the_interval_is_that_of_all_such_cameras(kind: str, detail: int) -> None:
    """Mean and variance of the squared error, as traces; before a world finer than f, errors of H act on its detail."""
    bias, shifts, noise = error_of(kind, detail)
    covariance, result = shifts @ shifts.T + noise @ noise.T, prepared(kind, detail)[1]
    given, part = not_none(result.interval), np.square(shifts).sum() / bias.size
    assert given.mse == pytest.approx(np.mean(np.square(bias) + np.diagonal(covariance)), rel=0.01)
    assert part > 0.03 * given.mse, "else it could be missing"
    assert result.expected.parts["calibration"] == pytest.approx(part, rel=0.1)
    variance = 2 * np.square(covariance).sum() + 4 * bias @ covariance @ bias
    assert given.variance == pytest.approx(variance / bias.size**2, rel=0.1)


def test_the_error_map_holds_the_errors_of_few_numbers_at_every_pixel() -> None:
    assumed, _ = prepared("independent")
    errors = not_none(shared_errors(assumed.method.task, operators_of(assumed), case()[2]))
    assert errors.exact
    np.testing.assert_allclose(errors.variance, np.square(error_of("independent")[1]).sum(axis=1), rtol=1e-7)


def test_random_combinations_have_the_same_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    assumed, _ = prepared("independent")
    task, operators, picture = assumed.method.task, operators_of(assumed), case()[2]
    exact = not_none(shared_errors(task, operators, picture))
    monkeypatch.setattr(module, "FEW_PIXELS", 0)
    monkeypatch.setattr(module, "DRAWS", COMBINATIONS)
    drawn = not_none(shared_errors(task, operators, picture))
    assert not drawn.exact
    gram = exact.images @ exact.images.T
    total, deviation = float(np.trace(gram)), (2 * float(np.square(gram).sum()) / COMBINATIONS) ** 0.5
    assert abs(float(drawn.variance.sum()) - total) < 4 * deviation < total / 2
    weights = np.random.default_rng(2).normal(size=picture.size)
    one, other = (errors.variance_of_sum(weights, task, operators) for errors in (exact, drawn))
    assert other == pytest.approx(one, rel=1e-9)
    # Pairs of combinations give tr K^2, on which the width of the interval depends.
    assert squared_trace(drawn.images @ drawn.images.T, exact=False) == pytest.approx(
        squared_trace(gram, exact=True), rel=4 * 2 / COMBINATIONS**0.5
    )


def test_errors_of_few_numbers_do_not_average_out_over_a_region() -> None:
    """On a slope, a view's shift changes all its readings alike: the mean of a region errs by three times more."""
    assumed, result = prepared("exponential")  # whose pixels' correlation does not change this
    slope_of_columns: FloatArray = 127.5 + 5.0 * np.tile(
        np.arange(SHAPE[1], dtype=np.float64) - SHAPE[1] // 2, SHAPE[0]
    )
    task, operators = assumed.method.task, operators_of(assumed)
    errors = not_none(shared_errors(task, operators, slope_of_columns))
    rows, columns = (np.arange(size) - size // 2 for size in SHAPE)
    weights = np.exp(-np.add.outer(rows**2, columns**2) / (2 * 4.0**2))
    weights /= weights.sum()
    means = weights.ravel() @ operators.gain(case()[1].errors(slope_of_columns).matrix.toarray())
    stated = errors.variance_of_sum(weights.ravel(), task, operators)
    assert stated == pytest.approx(np.square(means).sum(), rel=1e-7)
    independent, back = (
        task.model.errors(slope_of_columns),
        operators.weigh(task.observe(operators.posterior(weights.ravel()))),
    )
    assert independent is not None
    as_independent = float(independent.variance @ np.square(back))
    assert stated > 9 * as_independent
    added = result.variance_of_sum(weights.ravel()) - assumed.method.result(
        {"noise": assumed.noise["noise"]}, None
    ).variance_of_sum(weights.ravel())
    of_picture = not_none(
        shared_errors(task, operators, assumed.shared_image if assumed.shared_image is not None else weights)
    )
    assert added == pytest.approx(of_picture.variance_of_sum(weights.ravel(), task, operators), rel=1e-6)


def test_the_residual_is_that_of_all_such_cameras() -> None:
    """The expectation as a trace, and p-values of some draws."""
    assumed, result = prepared("independent")
    task, operators, (_, model, picture) = assumed.method.task, operators_of(assumed), case()
    power = not_none(result.residual_power)

    def left(readings: FloatArray) -> FloatArray:
        return (readings - task.model.matrix @ operators.gain(readings)) / np.sqrt(task.expected_noise)[:, None]

    light = model.forward(picture - assumed.prior.mean)[:, None]
    shifts, noise = model.errors(picture).matrix.toarray(), NOISE**0.5 * np.eye(model.measurements)
    exact = sum(np.square(left(each)).sum() for each in (light, shifts, noise))
    expected = float((not_none(power.bias) + not_none(power.noise)).sum())
    scatter = (2 * np.square(left(noise) @ left(noise).T).sum() / 32) ** 0.5
    assert abs(exact - expected) < 4 * scatter, "which is a mean over 32 draws of noise"
    rng = np.random.default_rng(1)
    drawn = shifts @ rng.normal(size=(shifts.shape[1], COMBINATIONS))
    drawn += noise @ rng.normal(size=(len(noise), COMBINATIONS))
    p_values: list[float] = []
    for column in left(light + drawn).T:
        each = WhitenedResidual(column**2, power, task.used, np.zeros(column.size), np.zeros(column.size))
        p_values += [part.p_value for part in residual_parts(each, model.camera)]
    assert min(p_values) > 1e-4 / len(p_values)


def test_a_sub_imager_off_by_ten_deviations_is_found() -> None:
    stack, model, picture = case()
    rng = np.random.default_rng(3)
    stack = recorded(stack, model, picture, rng)
    part = model.camera.slices()[4]
    values = stack.values.copy()
    values[part] += 10 * model.changes(picture)[1][part]
    wrong = restore(replace(stack, values=values), model, picture)
    assert not wrong.verdict.trusted
    assert "in sub-imager (1, 1) of type A, which explains" in " ".join(wrong.verdict.reasons)
    assert restore(stack, model, picture).verdict.trusted


def test_errors_without_effect_are_left_out_with_a_bound() -> None:
    result = restored("independent", 0, shift=1e-7).result
    assert 0 < not_none(result.left_out) < 1e-3 * result.expected.mse
    stack, model, picture = case("independent", 1e-7)
    choice = choose_method(stack.scene, stack.camera, exact=False)
    assumed = assumptions_for(recorded(stack, model, picture, np.random.default_rng(0)), model, choice, Execution())
    errors = not_none(shared_errors(assumed.method.task, operators_of(assumed), picture))
    assert float(errors.variance.mean()) < not_none(result.left_out)


def restored_as(method: str) -> MethodResult:
    """The result of one recording by a method."""
    stack, model, picture = case()
    changed = with_keys(stack.scene, estimator={"method": method}, tiles={"size": 15, "overlap": 4})
    recording = recorded(replace(stack, scene=changed), model, picture, np.random.default_rng(0))
    return restore(recording, replace(model, scene=changed), picture).result


@pytest.mark.slow
@pytest.mark.parametrize("method", ["frame", "tiles"])
def test_every_method_states_the_same_part(method: str) -> None:
    found, dense = restored_as(method), prepared("independent")[1]
    # An iterative solution is accurate to some thousandths.
    assert found.expected.parts["calibration"] == pytest.approx(dense.expected.parts["calibration"], rel=0.01)
    if method == "frame":
        assert not_none(found.interval).mse == pytest.approx(not_none(dense.interval).mse, rel=0.01)


@pytest.mark.slow
def test_the_interval_of_a_frame_is_that_of_the_dense_problem_on_average(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its variance is a trace by one random image, which of so few pixels scatters by a fifth."""
    dense, ratios = prepared("independent")[1].interval, list[float]()
    assert dense is not None
    for seed in range(20):
        monkeypatch.setattr(frame_method, "probe", lambda _, seed=seed: np.random.default_rng(seed))
        found = not_none(restored_as("frame").interval)
        ratios.append(found.variance / dense.variance)
    assert np.std(ratios) < 0.3
    assert abs(np.mean(ratios) - 1) < 3 * np.std(ratios, ddof=1) / len(ratios) ** 0.5


@pytest.mark.slow
def test_the_held_out_check_allows_for_errors_of_few_numbers() -> None:
    stack, model, _ = case("independent", 5 * SHIFT)
    rng = np.random.default_rng(4)
    deviates: list[float] = []
    image = np.zeros(model.unknowns)
    for _ in range(4):
        image = model.scene.prior.mean + model.scene.prior.variance**0.5 * rng.normal(size=model.unknowns)
        check = check_held_out(recorded(stack, model, image, rng), model, fitted=False)
        assert check.verdict.trusted
        deviates += [sub.z for sub in check.sub_imagers if sub.z is not None]
    # Taken for independent, they make the deviates spread by 1.2 to 1.6.
    assert abs(np.std(deviates) - 1) < 4 / (2 * len(deviates)) ** 0.5
    wrong = recorded(stack, model, image, rng)
    part, values = model.camera.slices()[4], wrong.values.copy()
    values[part] += 10 * model.changes(image)[1][part]
    check = check_held_out(replace(wrong, values=values), model, fitted=False)
    assert [sub.name for sub in check.sub_imagers if sub.named] == [model.camera.sub_imagers[4].name]
