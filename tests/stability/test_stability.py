"""Stiff and extreme cases against exact arithmetic: right to nine digits, or refused; never a silent loss."""

from __future__ import annotations

import csv
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from ommatid.reconstruct.prior import Prior
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.simulate.ideal import ideal_matrix
from ommatid.stability import stability
from ommatid.stability.cases import CHANGES, LENSES, StabilityCase, extreme_cases, noise_sweep
from ommatid.stability.exact_answer import exact_answer
from ommatid.stability.stability import DIGITS, FEWER, REFUSED, RIGHT, SILENT, assess

from ..benchmarks.nasty import FAMILIES
from ..examples import GALLERY

MATRICES = {
    name: ideal_matrix(derive(read(GALLERY / "tile19.toml", CHANGES, lenses))) for name, lenses in LENSES.items()
}
SWEEP = list(noise_sweep(MATRICES))
EXTREMES = list(extreme_cases(MATRICES))
INDEPENDENT = ("wide noise", "extreme prior", "whole numbers", "scaled", "hilbert", "large mean")  # priors of families
ALLOWED = {"solve": {RIGHT}, "solve or refuse": {RIGHT, REFUSED}, "refuse": {REFUSED}}


def graded_problem(seed: int) -> tuple[Problem, FloatArray]:
    """A larger problem: rows, columns or entries over many decades, exact and near null spaces, correlated pixels."""
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
    image = prior.mean + prior.apply_root(rng.normal(size=prior.dimension))
    g = matrix @ image + np.sqrt(noise) * rng.normal(size=m)
    return Problem(matrix, prior, noise), g.astype(np.float32).astype(float) if rng.random() < 0.1 else g


def case_of(problem: Problem, g: FloatArray) -> StabilityCase:
    return StabilityCase("random", problem.matrix, problem.prior, problem.noise_variance, g)


def rationals(problem: Problem, g: FloatArray) -> list[list[Fraction]]:
    """The image and the variances of independent pixels in rational numbers, from the first independent rows."""

    def exact(values: FloatArray) -> Any:
        ratios = (value.as_integer_ratio() for value in values.ravel().tolist())
        rows, columns = values.shape
        return flint.fmpq_mat(rows, columns, [flint.fmpq(*ratio) for ratio in ratios])

    h, noise, rows = (
        problem.matrix.toarray(),
        problem.noise_variance,
        np.flatnonzero(problem.noise_variance > 0).tolist(),
    )
    free = list[int]()
    for row in np.flatnonzero(noise == 0).tolist():
        if exact((h * problem.prior.root)[[*free, row]]).rank() > len(free):
            free.append(row)
    rows += free
    observed, prior, mean = exact(h[rows]), exact(np.diag(problem.prior.root)), exact(problem.prior.mean[:, None])
    cross = prior * prior * observed.transpose()
    gain = (observed * cross + exact(np.diag(noise[rows]))).inv() if rows else exact(np.empty((0, 0)))
    image = mean + cross * gain * (exact(g[rows, None]) - observed * mean)
    posterior = prior * prior - cross * gain * cross.transpose()
    return [
        [Fraction(int(entry.p), int(entry.q)) for entry in entries]
        for entries in (image.entries(), [posterior[k, k] for k in range(posterior.nrows())])
    ]


@given(st.sampled_from(INDEPENDENT), st.integers(0, 10**6))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_the_exact_answer_is_the_rational_one(family: str, seed: int) -> None:
    nasty = FAMILIES[family](np.random.default_rng(seed))
    answer = exact_answer(nasty.problem, nasty.recorded)
    if answer.contradiction > 0:  # the rounding of g without noise: the answer would depend on the order of rows
        return
    for exact, rational in zip((answer.image, answer.variance), rationals(nasty.problem, nasty.recorded), strict=True):
        largest = max(abs(value) for value in rational)
        for high, low, value in zip(exact.high.tolist(), exact.low.tolist(), rational, strict=True):
            assert abs(Fraction(high) + Fraction(low) - value) <= Fraction(1, 10**25) * largest


@pytest.mark.slow
@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_graded_problems_have_no_silent_loss(seed: int) -> None:
    problem, g = graded_problem(seed)
    assert assess(case_of(problem, g), exact_answer(problem, g)).verdict != SILENT


@pytest.mark.parametrize("cases", [SWEEP[18:21:2], pytest.param(SWEEP, marks=pytest.mark.slow)], ids=["few", "all"])
def test_every_noise_variance(cases: list[StabilityCase]) -> None:
    """Nine digits in the estimate and every variance."""
    for case in cases:
        outcome = assess(case, exact_answer(case.problem, case.recorded))
        assert outcome.verdict == RIGHT
        assert min(outcome.refined or 0.0, outcome.variance or 0.0) >= DIGITS


@pytest.mark.parametrize("cases", [EXTREMES[::40], pytest.param(EXTREMES, marks=pytest.mark.slow)], ids=["few", "all"])
def test_every_extreme_case_is_right_or_refused(cases: list[StabilityCase]) -> None:
    for case in cases:
        answer = None if case.required == "refuse" else exact_answer(case.problem, case.recorded)
        outcome = assess(case, answer)
        assert outcome.verdict in ALLOWED[case.required], outcome
        assert "\n" not in outcome.reason


def test_an_error_of_one_in_a_million_is_a_silent_loss() -> None:
    """The assessment itself: an estimate compared with the exact answer to other measurements."""
    case = next(case for case in SWEEP if case.name == "three types, noise 0.01")
    answer = exact_answer(case.problem, case.recorded * (1 + 1e-6))
    assert assess(case, answer).verdict == SILENT
    errors = (0.0, 1e-3, 1e9, float("nan"))
    assert [stability.digits(error) for error in errors] == [16.0, pytest.approx(3.0), 0.0, 0.0]


@pytest.mark.slow
def test_the_files_hold_every_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.stability.cases.NOISES", (1e-12, 1.0))
    monkeypatch.setattr(stability, "extreme_cases", lambda _: [EXTREMES[0], *EXTREMES[-2:]])
    progress: list[float] = []
    summary = stability.write_stability(tmp_path, MATRICES, progress.append)
    with (tmp_path / "stability.csv").open(encoding="utf-8") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 4 + 3
    assert summary["verdicts"] == {RIGHT: 5, REFUSED: 2, FEWER: 0, SILENT: 0}
    assert EXTREMES[-1].name in [line["case"] for line in lines]
    assert (tmp_path / "stability.png").stat().st_size > 20_000
    assert progress[-1] == 1.0
    assert EXTREMES[-1].name in dict(stability.rows(summary))["refused, for the reason in stability.csv"]
