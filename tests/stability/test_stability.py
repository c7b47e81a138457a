"""Stiff and extreme cases against exact arithmetic: right to nine digits, or refused; never wrong in silence."""

from __future__ import annotations

import csv
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from ommatid.reconstruct.estimator.estimate import FORMS, estimate
from ommatid.reconstruct.prior import Prior
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.simulate.ideal import ideal_matrix
from ommatid.stability.cases import CHANGES, LENSES, StabilityCase, cases, sweep
from ommatid.stability.exact_answer import exact_answer
from ommatid.stability.stability import AUTO, DIGITS, FEWER, REFUSED, RIGHT, SILENT, assess, digits, markdown, rows
from ommatid.stability.stability import write_stability as write

from ..examples import GALLERY

Vector = NDArray[np.float64]

MATRICES = {
    name: ideal_matrix(derive(read(GALLERY / "tile19.toml", CHANGES, lenses))) for name, lenses in LENSES.items()
}
SWEPT = [case for _, _, case in sweep(MATRICES)]
OTHERS = list(cases(MATRICES))
ALLOWED = {"regular": {RIGHT}, "beyond": {RIGHT, REFUSED}, "hopeless": {REFUSED}}


def exact(problem: Problem, g: Vector) -> tuple[list[Fraction], list[Fraction]]:
    """Image and variances in rationals, one measurement after the other: no formula of the reference's."""
    image = [Fraction(value) for value in problem.prior.mean.tolist()]
    roots = [Fraction(value) for value in problem.prior.root.tolist()]
    count = len(image)
    covariance = [[roots[i] ** 2 if i == j else Fraction(0) for j in range(count)] for i in range(count)]
    for row, reading, noise in zip(
        problem.matrix.toarray().tolist(), g.tolist(), problem.noise_variance.tolist(), strict=True
    ):
        h = [Fraction(value) for value in row]
        direction = [sum((line[j] * h[j] for j in range(count)), Fraction(0)) for line in covariance]
        innovation = sum((a * b for a, b in zip(h, direction, strict=True)), Fraction(noise))
        if innovation == 0:
            continue
        away = Fraction(reading) - sum((a * b for a, b in zip(h, image, strict=True)), Fraction(0))
        image = [value + step * away / innovation for value, step in zip(image, direction, strict=True)]
        covariance = [
            [covariance[i][j] - direction[i] * direction[j] / innovation for j in range(count)] for i in range(count)
        ]
    return image, [covariance[i][i] for i in range(count)]


def nasty(seed: int) -> tuple[Problem, Vector]:
    """A small problem of all that is hard: graded rows and columns, zeros, copies, noise of any size or none."""
    rng = np.random.default_rng(seed)
    m, n = rng.integers(1, 7, 2)
    dense = rng.integers(-3, 4, (m, n)).astype(float) / rng.choice([1.0, 3.0, 7.0])
    if rng.random() < 0.4:
        dense *= 10.0 ** rng.integers(-8, 9, (m, 1))
    if rng.random() < 0.4:
        dense *= 10.0 ** rng.integers(-4, 5, (1, n))
    if rng.random() < 0.4:
        dense[rng.integers(m)] = dense[rng.integers(m)]
    root = 10.0 ** rng.uniform(-3, 3, n) * (rng.random(n) > 0.15)
    noise = 10.0 ** rng.uniform(-18, 6, m) if rng.random() < 0.5 else np.full(m, 10.0 ** rng.uniform(-24, 6))
    noise[rng.random(m) < 0.1] = 0.0
    prior = Prior(rng.normal(size=n), root)
    matrix = sparse.csr_array(dense)
    image = prior.mean + root * rng.normal(size=n)
    return Problem(matrix, prior, noise), matrix @ image + np.sqrt(noise) * rng.normal(size=m)


@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_the_reference_is_the_rational_answer(seed: int) -> None:
    problem, g = nasty(seed)
    found = exact_answer(problem, g)
    if found.contradiction > 0:  # rounding of g where there is no noise: then the order of measurements would matter
        return
    image, variance = exact(problem, g)
    for ours, right in ((found.image, image), (found.variance, variance)):
        for high, low, value in zip(ours.high.tolist(), ours.low.tolist(), right, strict=True):
            largest = max(abs(one) for one in right)
            assert abs(Fraction(high) + Fraction(low) - value) <= Fraction(1, 10**25) * largest


@given(st.integers(0, 10**6))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_nasty_problems_are_right_to_the_tolerance_or_refused(seed: int) -> None:
    problem, g = nasty(seed)
    case = StabilityCase("nasty", problem.matrix, problem.prior, problem.noise_variance, g)
    outcome = assess(case, AUTO, exact_answer(problem, g))
    assert outcome.verdict in (RIGHT, REFUSED, FEWER)
    if outcome.verdict != REFUSED:
        assert outcome.refined is not None
        assert outcome.variance is not None
        assert min(outcome.refined, outcome.variance) >= 7  # the tolerance, and ten for the sample


def graded(seed: int) -> tuple[Problem, Vector]:
    """A larger one: rows, columns or entries over many decades, null spaces exact or nearly so, correlated pixels."""
    rng = np.random.default_rng(seed)
    m, n = rng.integers(1, 25, 2)
    draws = (
        lambda: rng.integers(-3, 4, (m, n)).astype(float),
        lambda: (rng.integers(-2, 3, (m, 3)) @ rng.integers(-2, 3, (3, n))).astype(float),
        lambda: rng.normal(size=(m, 3)) @ rng.normal(size=(3, n)),
        lambda: rng.normal(size=(m, n)) * 10.0 ** rng.uniform(-8, 8, (m, n)),
    )
    dense = draws[rng.integers(len(draws))]()
    if rng.random() < 0.3:
        dense *= 2.0 ** rng.integers(-30, 30, (m, 1))
    if rng.random() < 0.3:
        dense *= 2.0 ** rng.integers(-20, 20, (1, n))
    if rng.random() < 0.3:
        dense[rng.random((m, n)) < 0.6] = 0.0
    root = np.full(n, 10.0 ** rng.uniform(-15, 15))
    if rng.random() < 0.3:
        root = rng.integers(-4, 5, (n, rng.integers(1, n + 2))).astype(float)
    noise = 10.0 ** rng.uniform(-30, 12, m) if rng.random() < 0.3 else np.full(m, 10.0 ** rng.uniform(-30, 12))
    noise[rng.random(m) < rng.choice([0.0, 0.1, 1.0])] = 0.0
    prior = Prior(rng.normal(size=n) * rng.choice([0, 1, 100]), root)
    matrix = sparse.csr_array(dense)
    image = prior.mean + prior.spread(rng.normal(size=prior.freedoms))
    g = matrix @ image + np.sqrt(noise) * rng.normal(size=m)
    return Problem(matrix, prior, noise), g.astype(np.float32).astype(float) if rng.random() < 0.1 else g


@given(st.integers(0, 10**6))
@settings(max_examples=250, deadline=None, derandomize=True)
def test_graded_problems_are_never_wrong_in_silence(seed: int) -> None:
    problem, g = graded(seed)
    case = StabilityCase("graded", problem.matrix, problem.prior, problem.noise_variance, g)
    exact = exact_answer(problem, g)
    asked = AUTO if seed % 3 else sorted(FORMS)[seed % len(FORMS)]
    assert assess(case, asked, exact).verdict != SILENT


def test_most_nasty_problems_are_solved() -> None:
    """Refusing everything would be no silent loss either."""
    solved = 0
    for seed in range(200):
        problem, g = nasty(seed)
        try:
            estimate(problem, g)
            solved += 1
        except InputError:
            continue
    assert solved >= 180


@pytest.mark.parametrize("case", SWEPT, ids=lambda case: case.name)
def test_every_noise_in_every_form(case: StabilityCase) -> None:
    """`auto` is right to nine digits, in the estimate and in every variance; no form claims more than it has."""
    answer = exact_answer(case.problem, case.recorded)
    outcomes = {asked: assess(case, asked, answer) for asked in (AUTO, *FORMS)}
    assert outcomes[AUTO].verdict == RIGHT
    right = (outcomes[AUTO].refined or 0.0, outcomes[AUTO].variance or 0.0)
    assert min(right) >= DIGITS
    assert SILENT not in {outcome.verdict for outcome in outcomes.values()}


@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.name)
def test_every_extreme_case_is_right_or_refused(case: StabilityCase) -> None:
    answer = None if case.kind == "hopeless" else exact_answer(case.problem, case.recorded)
    outcome = assess(case, AUTO, answer)
    assert outcome.verdict in ALLOWED[case.kind], outcome
    assert "\n" not in outcome.reason


def test_no_form_is_wrong_in_silence_on_the_hardest() -> None:
    """Where `auto` goes to the sturdiest forms, every other one, asked for by name, refuses or says what it has."""
    hard = [
        case for case in OTHERS if any(word in case.name for word in ("1e-12 to 1e12, noise 1e-12", "beside", "no n"))
    ]
    assert len(hard) >= 9
    for case in hard:
        answer = exact_answer(case.problem, case.recorded)
        assert SILENT not in {assess(case, form, answer).verdict for form in FORMS}


def test_a_lie_is_found_out() -> None:
    """The judge itself: an answer to other measurements than it is held against is a silent loss."""
    case = next(case for case in SWEPT if case.name == "three types, noise 0.01")
    answer = exact_answer(case.problem, case.recorded * (1 + 1e-6))
    assert assess(case, AUTO, answer).verdict == SILENT
    assert [digits(error) for error in (0.0, 1e-3, 1e9, float("nan"))] == [16.0, pytest.approx(3.0), 0.0, 0.0]


def test_the_files_hold_every_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.stability.cases.NOISES", (1e-12, 1.0))
    monkeypatch.setattr("ommatid.stability.stability.cases", lambda _: [OTHERS[0], *OTHERS[-2:]])
    done: list[float] = []
    summary = write(tmp_path, MATRICES, done.append)
    with (tmp_path / "stability.csv").open(encoding="utf-8") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 4 * 7 + 3
    assert summary["silent_losses_of_any_form"] == 0
    assert summary["auto"][REFUSED] == 2
    table = (tmp_path / "stability.md").read_text(encoding="utf-8")
    assert table.count("\n|") == 2 + 4 + 3
    assert OTHERS[-1].name in table
    assert (tmp_path / "stability.png").stat().st_size > 20_000
    assert done[-1] == 1.0
    assert OTHERS[-1].name in dict(rows(summary))["refused, with the sentence in stability.md"]
    assert markdown([]).startswith("# Stiff")
