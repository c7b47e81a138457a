"""The expected residual against explicit matrices and draws of the prior, its p-values, and the resulting verdicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from ommatid.reconstruct.expected_error import Interval, expected_error, interval
from ommatid.reconstruct.forms.cholesky import information
from ommatid.reconstruct.methods.dense_method import DRAWS, residual_power
from ommatid.reconstruct.output.run_json import VerdictReport
from ommatid.reconstruct.problem import Problem
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.reconstruct.verdict.residual import ResidualPower, WhitenedResidual, regions, residual_parts
from ommatid.reconstruct.verdict.verdict import error_p_value, excesses, with_gain
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model

from ..examples import (
    THREE,
    camera,
    covariance_of,
    form_of,
    gain_and_error,
    not_none,
    random_problem,
    scene,
    slow,
    tile_problem,
    with_keys,
)
from ..frames import FITTED, P0, recorded, wide

NOISE = 1e-2
DRAWN = 300  # images of the prior
FRAME = (34, 31)  # rows and columns


def explicit(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """H A by Eq. 4, and the covariance of g - H f0, by their definitions: (M, M) each."""
    matrix, prior = problem.matrix.toarray(), covariance_of(problem.prior)
    gain, _ = gain_and_error(matrix, prior, problem.noise_variance)
    return matrix @ gain, matrix @ prior @ matrix.T + np.diag(problem.noise_variance)


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("shape", [(7, 5), (5, 7)])
def test_the_leverage_is_the_diagonal_of_h_a(correlated: bool, shape: tuple[int, int]) -> None:
    problem = random_problem(3, *shape, correlated=correlated)
    form = form_of(problem)
    leverage = expected_error(form, {"noise": problem.noise_variance}).leverage
    assert leverage == pytest.approx(np.diagonal(explicit(problem)[0]), rel=1e-9)
    power = not_none(residual_power(form, problem.noise_variance, leverage, problem.prior.mean))
    assert power.prior == pytest.approx(1 - np.asarray(leverage), rel=1e-9), "exact"
    assert expected_error(form, {}, np.array([1])).leverage is None, "of some pixels only"


@pytest.mark.parametrize("factor", [0.3, 4.0])
def test_the_expected_squares_with_another_noise_and_for_a_known_image(factor: float) -> None:
    """Sums over all measurements against traces of explicit matrices; those of random draws within 5 deviations."""
    problem = random_problem(4, 40, 30)
    form, rng = information(problem), np.random.default_rng(0)
    actual, truth = factor * problem.noise_variance, problem.prior.mean + rng.normal(0, 4, 30)
    leverage = expected_error(form, {"noise": actual}).leverage
    power = not_none(residual_power(form, actual, leverage, truth))
    gain, covariance = explicit(problem)
    rest, white = np.eye(40) - gain, 1 / np.sqrt(problem.noise_variance)
    bias = white * (rest @ (problem.matrix @ (truth - problem.prior.mean)))
    assert not_none(power.bias) == pytest.approx(bias**2, rel=1e-8)
    changed = covariance + np.diag(actual - problem.noise_variance)
    for found, middle in ((not_none(power.noise), np.diag(actual)), (power.prior, changed)):
        whitened = white[:, None] * rest @ middle @ rest.T * white
        deviation = (2 * np.square(whitened).sum() / DRAWS) ** 0.5
        assert abs(found.sum() - np.trace(whitened)) < 5 * deviation


@pytest.mark.parametrize(("method", "shape"), [("frame", (25, 22)), ("tiles", FRAME), slow("frame", FRAME)])
def test_frames_and_tiles_expect_the_residual_of_the_dense_estimate(method: str, shape: tuple[int, int]) -> None:
    """Chi-squared and its expectation in every part agree with those of the dense problem within 5 deviations.

    Tiles leave more residual than the optimal estimate, so theirs is compared with its own expectation.
    """
    described = wide(shape, noise={"variance": NOISE}, tiles={"size": 24, "overlap": 6})
    truth = 127.5 + np.random.default_rng(0).normal(0, P0**0.5, shape[0] * shape[1])
    results: list[Reconstruction] = []
    for name in ("auto", method):
        changed = with_keys(described, estimator={"method": name, "accuracy": 1e-6})
        results.append(restore(recorded(changed, truth, NOISE), ideal_model(changed, derive(changed)), truth))
    dense, other = (result.verdict.parts for result in results)
    assert [(part.kind, part.name) for part in dense] == [(part.kind, part.name) for part in other]
    for exact, drawn in zip(dense, other, strict=True):
        assert abs(drawn.chi_squared - drawn.expected) < 5 * drawn.deviation, drawn
        if method == "frame":
            assert abs(drawn.prior - exact.prior) < 5 * (2 * exact.prior / 2) ** 0.5
            assert drawn.chi_squared == pytest.approx(exact.chi_squared, rel=1e-3)
    assert all(result.verdict.trusted for result in results)
    assert other[0].prior >= 0.9 * dense[0].prior


@given(st.floats(1e-3, 1e3))
def test_the_verdict_does_not_depend_on_the_unit_of_the_image(unit: float) -> None:
    """The whitened residual and its expectation do not change if all values are multiplied by one number."""
    problem = random_problem(6, 8, 5)
    prior = replace(problem.prior, mean=unit * problem.prior.mean, root=unit * problem.prior.root)
    scaled = Problem(problem.matrix, prior, unit**2 * problem.noise_variance)
    truth = problem.prior.mean + np.arange(5)
    powers = [
        residual_power(information(case), case.noise_variance, np.full(8, 0.5), factor * truth)
        for case, factor in ((problem, 1.0), (scaled, unit))
    ]
    for name in ("bias", "noise"):
        first, second = (getattr(power, name) for power in powers)
        assert first == pytest.approx(second, rel=1e-7)


def power_of(problem: Problem) -> tuple[Any, ResidualPower]:
    form = information(problem)
    leverage = expected_error(form, {"noise": problem.noise_variance}).leverage
    power = not_none(residual_power(form, problem.noise_variance, leverage, None))
    return form, power


def test_p_values_of_all_parts_are_rare_enough() -> None:
    """Over 300 draws of the prior, p-values below 1 % are at most as frequent as that, by a binomial test at 1e-3."""
    tile, problem = camera(), tile_problem(3, NOISE)
    form, power = power_of(problem)
    rng, counts = np.random.default_rng(5), dict[str, list[int]]()
    images = problem.prior.root[:, None] * rng.normal(size=(361, DRAWN))
    deviations = problem.matrix @ images + NOISE**0.5 * rng.normal(size=(706, DRAWN))
    residuals = deviations - problem.matrix @ form.gain(deviations)
    zeros, used = np.zeros(706), np.ones(706, dtype=bool)
    for column in residuals.T:
        parts = residual_parts(WhitenedResidual(column**2 / NOISE, power, used, zeros, zeros), tile)
        for part in parts:
            counts.setdefault(part.kind, []).append(part.p_value < 0.01)
    assert {kind: len(values) // DRAWN for kind, values in counts.items()} == {
        "all": 1,
        "lens type": 3,
        "sub-imager": 50,
        "region": 9,
    }
    for kind, values in counts.items():
        assert stats.binomtest(sum(values), len(values), 0.01, "greater").pvalue > 1e-3, kind


def test_regions_are_where_the_rows_of_h_have_their_centre() -> None:
    shaped = derive(wide((24, 30)))
    matrix, (rows, cols) = ideal_matrix(shaped), np.indices((24, 30)).reshape(2, -1) + 0.5
    centres = [np.clip(matrix @ axis * 3 / size, 0, 2).astype(int) for axis, size in ((rows, 24), (cols, 30))]
    assert regions(shaped).tolist() == (3 * centres[0] + centres[1]).tolist()


def test_the_p_value_of_an_error_is_that_of_its_gamma_variate() -> None:
    mean, variance = 12.0, 9.0
    expected = interval(mean, variance, 4)
    gamma = stats.gamma(mean**2 / variance, scale=variance / mean / 4)
    for mse in (1.0, 2.0, 4.0, 7.0):
        assert error_p_value(mse, expected) == pytest.approx(min(gamma.sf(mse), 1.0) if mse > 3 else gamma.cdf(mse))
    assert error_p_value(2.0, Interval(1.0, 1.0, 1.0)) == 0.0


# --- verdicts


def stack_of(factor: float = 1.0, **tables: Any) -> Stack:
    """The stack of a drawn image with `factor` times the noise variance of the scene."""
    noise: dict[str, Any] = {"variance": NOISE}
    described = scene(lenses=THREE, noise=tables.pop("noise", noise), **tables)
    return recorded(described, drawn_image(), factor * NOISE, seed=1)


def drawn_image() -> FloatArray:
    return 127.5 + np.random.default_rng(3).normal(0, P0**0.5, 361)


def without(pixels: slice) -> Stack:
    """The stack with dead pixels."""
    stack = stack_of()
    values = stack.values.copy()
    values[pixels] = np.nan
    return replace(stack, values=values)


def rough() -> Stack:
    """A prior with a millionth of the image's variance: the residual exceeds its draws, and is that of this image."""
    return stack_of(prior={"variance": P0 / 1e6})


def noiseless() -> Stack:
    described = scene(lenses=THREE, noise={"variance": 0.0}, estimator={"noise_variance": 0.0})
    return recorded(described, drawn_image(), 0.0)


def flat() -> Stack:
    described = wide(FRAME, FITTED[:1], noise={"variance": 300.0})
    return recorded(described, np.full(FRAME[0] * FRAME[1], 127.5), 300.0)


LEFT_OUT = "sub-imager (0, 0) of type A gives no usable pixel and is left out"
VERDICTS: dict[str, tuple[Callable[[], Stack], bool, bool, tuple[str, ...]]] = {  # known truth, trusted, what is said
    "drawn image": (stack_of, True, True, ()),
    "less noise": (
        lambda: stack_of(0.05),
        True,
        True,
        ("below its 99 % interval", ": the noise is smaller than stated"),
    ),
    "dead sub-imager": (lambda: without(slice(0, 25)), False, True, (LEFT_OUT,)),
    "no pixel": (lambda: without(slice(None)), False, False, ("the prior and not an image",)),
    "flat image": (flat, False, True, ("smoother than the prior",)),
    "rough image": (rough, False, False, ()),
    "rough image, known": (rough, True, True, ()),
    "no noise": (noiseless, False, True, ("chi-squared was not checked", "the truth is not known")),
    "fitted noise": (
        lambda: stack_of(3.0, estimator={"noise_variance": "fit"}),
        False,
        True,
        ("the noise was fitted",),
    ),
    # Eq. 5 takes the known noise whatever the estimator expects, so its error bars hold.
    "assumed noise, low": (lambda: stack_of(estimator={"noise_variance": 1e-4}), True, True, ()),
    "assumed noise, high": (lambda: stack_of(estimator={"noise_variance": 1.0}), True, True, ()),
}


@pytest.mark.parametrize("name", VERDICTS)
def test_verdicts_and_what_is_said(name: str) -> None:
    make, known, trusted, words = VERDICTS[name]
    stack = make()
    found = restore(stack, ideal_model(stack.scene, stack.camera), drawn_image() if known else None).verdict
    assert found.trusted is trusted
    said = "; ".join(found.notes if trusted else found.reasons)
    assert all(each in said for each in words), said
    if name == "drawn image":
        assert (len(found.passed), found.notes) == (2, ())


def test_a_tenth_is_needed_beside_significance() -> None:
    """With 9,000 pixels 5 % more noise is significant, but no number is wrong by a tenth."""
    large = derive(wide((58, 58)))
    count = large.measurements
    unit, zeros = ResidualPower(np.ones(count), None, None, 0), np.zeros(count)
    noise, used = np.random.default_rng(0).chisquare(1, count), np.ones(count, dtype=bool)
    for factor, alarmed in ((1.0, False), (1.08, False), (1.25, True)):
        parts = residual_parts(WhitenedResidual(factor * noise, unit, used, zeros, zeros), large)
        assert (parts[0] in excesses(parts)) == alarmed
        assert (parts[0].p_value < 1e-4) == (factor > 1)


def test_a_result_worse_than_a_sub_image_is_amber() -> None:
    good = VerdictReport(trusted=True, reasons=())
    for gain, prior, level in ((0.1, "fit", "green"), (None, "fit", "green"), (-0.1, "fit", "amber")):
        assert with_gain(good, gain, prior).level == level
    assert "set prior.kind to 'fit'" in with_gain(good, -2.0, "independent").doubts[0]
    assert with_gain(VerdictReport(trusted=False, reasons=("no",)), -2.0, "fit").level == "red"
