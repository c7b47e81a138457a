"""Misalignment found from the stack: derivatives, errors against the truth, what the estimate gains, and refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from ommatid.reconstruct.misalignment.alignment import Alignment, align, recording_of
from ommatid.reconstruct.misalignment.likelihood import LikelihoodPoint, point_at
from ommatid.reconstruct.misalignment.robust_noise import as_table, misaligned_matrix, tolerances
from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.pose import misalignments
from ommatid.scenes.tables.camera import ToleranceTable

from ..examples import familywise, scene

Vector = NDArray[np.float64]

NOISE = 1e-3
SIGNIFICANCE = 0.01
SIDE = 12
SEEN = 18
ONE = (("1/2", [3, 3], "fit"),)
TWO = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))
POSITION = {"position": "40 nm"}  # of lenses 1 and 2 mm before the sensor: 0.01 to 0.03 pixels of f


def crooked(side: int = SIDE, seed: int = 0, tolerance: dict[str, Any] = POSITION) -> Camera:
    camera = derive(scene((side, side), TWO))
    return replace(camera, tolerance=ToleranceTable.model_validate({"seed": seed, **tolerance}))


def truly(camera: Camera) -> NDArray[np.float64]:
    return as_table(misalignments(camera))


def recorded(camera: Camera, image: Vector, rng: np.random.Generator, table: NDArray[np.float64]) -> Vector:
    light = misaligned_matrix(camera, table) @ image
    return light + NOISE**0.5 * rng.standard_normal(light.size)


def drawn(prior: Prior, rng: np.random.Generator) -> Vector:
    return prior.mean + prior.apply_root(rng.standard_normal(prior.dimension))


def fitted(camera: Camera, values: Vector, prior: Prior) -> Alignment:
    return align(camera, values, np.full(values.size, NOISE), prior)


def distance(found: Alignment, table: NDArray[np.float64]) -> float:
    """Squares of the errors in units of their expected covariance, chi-squared of as many degrees as numbers."""
    error = (as_table(found.misalignments) - table)[tuple(found.numbers.T)]
    return float(error @ np.linalg.solve(found.covariance, error))


PRIORS = {
    "independent": independent(127.5, 5461.25, SIDE * SIDE),
    "exponential": exponential(127.5, 5461.25, (SIDE, SIDE), 8.0),
}
ALL = {"position": "40 nm", "tilt": "1 deg", "rotation": "3 mrad", "focal_length": 2e-3}


@pytest.mark.parametrize("tolerance", [POSITION, ALL], ids=["position", "all"])
@pytest.mark.parametrize("name", PRIORS)
def test_derivatives_are_those_of_the_value(name: str, tolerance: dict[str, Any]) -> None:
    camera, rng, prior = crooked(tolerance=tolerance), np.random.default_rng(1), PRIORS[name]
    values = recorded(camera, drawn(prior, rng), rng, truly(camera))
    recording = recording_of(camera, values, rng.uniform(0.5, 2.0, values.size), prior)
    point = point_at(recording, rng.standard_normal(len(recording.free)))
    step, some = 1e-4, rng.choice(len(recording.free), 3, replace=False)
    changes = point.changes(np.full(point.scores.size, step))
    curvature = changes.curvature()
    one_sub = np.equal.outer(recording.free[:, 0], recording.free[:, 0])
    for place in some:
        unit = step * np.eye(point.scores.size)[place]
        above, below = (point_at(recording, point.scores + sign * unit) for sign in (1, -1))
        assert (above.value - below.value) / (2 * step) == pytest.approx(changes.gradient[place], rel=1e-4, abs=1e-4)
        moved = (above.image - below.image) / (2 * step)
        np.testing.assert_allclose(changes.shifts[:, place], moved, rtol=1e-3, atol=1e-3 * np.abs(moved).max())
        # Between kinks H is linear in each offset, but second derivatives of H by two numbers of one lens are left out.
        bent = [end.changes(np.full(point.scores.size, step)).gradient for end in (above, below)]
        differences, told = (bent[0] - bent[1]) / (2 * step), curvature[place]
        elsewhere = ~one_sub[place]
        scale = np.sqrt(np.diagonal(curvature) * curvature[place, place])
        np.testing.assert_allclose(
            told[elsewhere] / scale[elsewhere], differences[elsewhere] / scale[elsewhere], atol=2e-3
        )
        if tolerance is POSITION:
            assert told[place] == pytest.approx(differences[place], rel=2e-3)


def known(camera: Camera, values: Vector, prior: Prior, table: NDArray[np.float64]) -> LikelihoodPoint:
    """The estimate where misalignments are taken to be these."""
    matrix = misaligned_matrix(camera, table)
    recording = recording_of(camera, values, np.full(values.size, NOISE), prior)
    return point_at(replace(recording, matrix_of=lambda _: matrix), np.zeros(len(recording.free)))


def test_on_images_drawn_from_the_prior_errors_are_as_large_as_they_are_said_to_be() -> None:
    rng, prior = np.random.default_rng(2), PRIORS["exponential"]
    squares: list[float] = []
    excess: list[float] = []
    degrees = 0
    for seed in range(5):
        camera = crooked(seed=seed)
        image = drawn(prior, rng)
        values = recorded(camera, image, rng, truly(camera))
        found = fitted(camera, values, prior)
        point = known(camera, values, prior, as_table(found.misalignments))
        squares.append(distance(found, truly(camera)))
        degrees += len(found.numbers)
        excess.append(float(np.mean((point.image - image) ** 2 - np.diagonal(point.covariance) - found.variance)))
    # Numbers that lie on a kink are no Gaussian ones, so squares are a little larger than chi-squared.
    assert stats.chi2.ppf(SIGNIFICANCE / 2, degrees) < sum(squares) < 1.2 * stats.chi2.isf(SIGNIFICANCE / 2, degrees)
    t = np.mean(excess) / (np.std(excess, ddof=1) / len(excess) ** 0.5)
    assert abs(t) < stats.t.isf(SIGNIFICANCE / 2, len(excess) - 1)


def test_on_a_photograph_the_fitted_camera_is_nearly_as_good_as_the_true_one() -> None:
    errors: list[list[float]] = []
    for seed in range(2):
        camera = replace(
            derive(scene((SEEN, SEEN), ONE)), tolerance=ToleranceTable.model_validate({"seed": seed, **POSITION})
        )
        image = load(scene((SEEN, SEEN), ONE)).astype(np.float64).ravel()
        prior = exponential(127.5, 5461.25, (SEEN, SEEN), 20.0)
        values = recorded(camera, image, np.random.default_rng(seed), truly(camera))
        found = fitted(camera, values, prior)
        error = as_table(found.misalignments) - truly(camera)
        z = error[tuple(found.numbers.T)] / as_table(found.deviations)[tuple(found.numbers.T)]
        assert found.converged
        assert np.abs(z).max() < stats.norm.isf(familywise(z.size) / 2)
        tables = np.zeros_like(error), as_table(found.misalignments), truly(camera)
        errors.append([float(np.mean((known(camera, values, prior, table).image - image) ** 2)) for table in tables])
    trust, mine, best = np.mean(errors, axis=0)
    assert mine < 1.1 * best
    assert best < 0.8 * trust


def test_a_camera_that_stands_as_drawn_is_found_so() -> None:
    camera, rng, prior = crooked(), np.random.default_rng(4), PRIORS["exponential"]
    found = fitted(camera, recorded(camera, drawn(prior, rng), rng, 0 * truly(camera)), prior)
    z = as_table(found.misalignments)[tuple(found.numbers.T)] / as_table(found.deviations)[tuple(found.numbers.T)]
    assert np.abs(z).max() < stats.norm.isf(familywise(z.size) / 2)
    assert (as_table(found.deviations) < tolerances(camera) + 1e-12).all(), "a stack only adds to what was known"


def test_what_measurements_do_not_tell_stays_with_the_tolerance() -> None:
    camera, rng, prior = crooked(), np.random.default_rng(5), PRIORS["exponential"]
    values = recorded(camera, drawn(prior, rng), rng, truly(camera))
    found = align(camera, values, np.full(values.size, 1e8), prior)
    np.testing.assert_allclose(as_table(found.deviations), tolerances(camera), rtol=1e-3)
    assert np.abs(as_table(found.misalignments)).max() < 0.01 * tolerances(camera).max()


def test_pixels_left_out_count_for_nothing() -> None:
    camera, rng, prior = crooked(), np.random.default_rng(6), PRIORS["exponential"]
    values = recorded(camera, drawn(prior, rng), rng, truly(camera))
    used = rng.random(values.size) < 0.9
    noise = np.where(used, NOISE, 1e12)
    masked, drowned = align(camera, values[used], noise[used], prior, used), align(camera, values, noise, prior)
    assert np.abs(as_table(masked.misalignments) - as_table(drowned.misalignments)).max() < 0.1 * 40e-6
    assert masked.matrix.shape == drowned.matrix.shape


def test_variance_of_a_sum_holds_that_of_a_pixel() -> None:
    camera, rng, prior = crooked(), np.random.default_rng(7), PRIORS["exponential"]
    found = fitted(camera, recorded(camera, drawn(prior, rng), rng, truly(camera)), prior)
    assert found.variance_of_sum(np.eye(prior.mean.size)[5]) == pytest.approx(found.variance[5])


def test_what_it_cannot_do_is_refused() -> None:
    camera, prior = crooked(), PRIORS["independent"]
    values = np.zeros(camera.measurements)
    with pytest.raises(InputError, match=r"add a \[camera\.tolerance\]"):
        align(replace(camera, tolerance=None), values, values + 1, prior)
    with pytest.raises(InputError, match="needs noise in every measurement"):
        align(camera, values, values, prior)
    with pytest.raises(InputError, match="up to 4000 pixels of f, got 100 x 100; take 'robust'"):
        align(crooked(100), values, values + 1, prior)
