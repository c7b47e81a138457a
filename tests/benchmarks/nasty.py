"""Random problems that leave float64 few digits, each against the exact answer of Eq. 4 and 5.

`python -m tests.benchmarks nasty FOLDER` solves 100,000 of them. It continues where it was interrupted; a folder is for
one version of the program. An answer is silently wrong if its error exceeds ten times its stated bound and 1e-9;
anything else is right or refused with a reason.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import sparse

from ommatid.reconstruct.estimator.certificate import NEGLIGIBLE_VARIANCE
from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.prior import Prior, exponential
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.study import Row, study
from ommatid.stability.exact_answer import exact_answer, relative_error, worst_relative_error

EACH = 6667  # problems of every family of the whole campaign
LEAST_ERROR = 1e-9  # an error below it is never silent
ALLOWED_EXCESS = 10.0  # ratio of an error to its bound, which for variances is of a sample
CONTRADICTION = 1e-5  # of measurements without noise: a larger one must be refused
MEAN, DEVIATION = 127.5, 73.9
RIGHT, REFUSED, SILENT = "right", "refused", "silently wrong"

Generator = np.random.Generator


@dataclass(frozen=True)
class NastyProblem:
    """A problem with its measurements, (M,)."""

    problem: Problem
    recorded: FloatArray


@dataclass(frozen=True)
class NastyOutcome:
    """What became of a problem: "right", "refused" or "silently wrong", with the errors of u and of the variances."""

    family: str
    seed: int
    outcome: str
    error: float = 0.0
    bound: float = 0.0
    variance_error: float = 0.0
    variance_bound: float = 0.0
    reason: str = ""


def drawn(matrix: FloatArray, prior: Prior, noise: FloatArray, rng: Generator) -> NastyProblem:
    """Return a problem with the measurements of an image drawn from its prior."""
    image = prior.mean + prior.apply_root(rng.normal(size=prior.dimension))
    recorded = matrix @ image + np.sqrt(noise) * rng.normal(size=matrix.shape[0])
    return NastyProblem(Problem(sparse.csr_array(matrix), prior, noise), recorded)


def _paper(count: int) -> Prior:
    return Prior(np.full(count, MEAN), np.full(count, DEVIATION))


def _centred(count: int) -> Prior:
    """The image's mean is known."""
    return Prior(np.full(count, MEAN), DEVIATION * (np.eye(count) - 1 / count))


def _powers(rng: Generator, low: float, high: float, size: int | tuple[int, int]) -> FloatArray:
    return np.asarray(10.0 ** rng.uniform(low, high, size))


def _sizes(rng: Generator) -> tuple[int, int]:
    return int(rng.integers(1, 7)), int(rng.integers(1, 6))


def _nearly_equal(rng: Generator, count: int, spread: int) -> FloatArray:
    """Two rows that differ in their last digits, and up to two others."""
    row = rng.uniform(-1, 1, count)
    other = row * (1 + 2.0**-52 * rng.integers(-spread, spread + 1, count))
    return np.vstack([row, other, rng.uniform(-1, 1, (int(rng.integers(0, 3)), count))])


def nearly_equal_noisy(rng: Generator) -> NastyProblem:
    """Rows that differ in the last digits, with noise of 1e-24 to 1e-6, unlike from row to row."""
    count = int(rng.integers(2, 5))
    matrix = _nearly_equal(rng, count, int(rng.choice([1, 4, 100, 10_000])))
    prior = Prior(np.full(count, MEAN), _powers(rng, 0, 4, count))
    return drawn(matrix, prior, _powers(rng, -24, -6, matrix.shape[0]), rng)


def nearly_equal_exact(rng: Generator) -> NastyProblem:
    """Such rows without noise, below a prior whose mean is known; some of the others have noise."""
    count = int(rng.integers(2, 5))
    matrix = np.abs(_nearly_equal(rng, count, 4))
    noise = np.where(rng.random(matrix.shape[0]) < 0.5, 0.0, _powers(rng, -14, -8, matrix.shape[0]))
    noise[:2] = 0.0
    return drawn(matrix, _centred(count) if rng.random() < 0.8 else _paper(count), noise, rng)


def extreme_noise(rng: Generator) -> NastyProblem:
    """One noise variance of 1e-30 to 1e30."""
    measurements, count = _sizes(rng)
    noise = np.full(measurements, float(_powers(rng, -30, 30, 1)[0]))
    return drawn(rng.uniform(0, 1, (measurements, count)), _paper(count), noise, rng)


def wide_noise(rng: Generator) -> NastyProblem:
    """Noise variances that differ by up to 40 decades, some of them 0."""
    measurements, count = _sizes(rng)
    noise = _powers(rng, -30, 10, measurements)
    noise[rng.random(measurements) < 0.2] = 0.0
    return drawn(rng.uniform(-1, 1, (measurements, count)), _paper(count), noise, rng)


def denormal_noise(rng: Generator) -> NastyProblem:
    """Noise variances near the least float64, where products lose digits."""
    measurements, count = _sizes(rng)
    return drawn(rng.uniform(0, 1, (measurements, count)), _paper(count), _powers(rng, -323.3, -290, measurements), rng)


def extreme_entries(rng: Generator) -> NastyProblem:
    """H of 1e-300 to 1e300, or with a different size in every row."""
    measurements, count = _sizes(rng)
    scale = _powers(rng, -300, 300, (measurements if rng.random() < 0.3 else 1, 1))
    noise = _powers(rng, -30, 30, measurements) * (rng.random() < 0.8)
    with np.errstate(all="ignore"):
        return drawn(rng.uniform(0, 1, (measurements, count)) * scale, _paper(count), noise, rng)


def extreme_prior(rng: Generator) -> NastyProblem:
    """Prior variances of 1e-60 to 1e60, alike or from pixel to pixel."""
    measurements, count = _sizes(rng)
    alike = rng.random() < 0.5
    deviation = np.ones(count) * _powers(rng, -30, 30, 1 if alike else count)
    noise = _powers(rng, -30, 10, measurements) * (rng.random() < 0.8)
    return drawn(rng.uniform(0, 1, (measurements, count)), Prior(np.full(count, MEAN), deviation), noise, rng)


def singular_prior(rng: Generator) -> NastyProblem:
    """Known pixels, a known mean, or fewer columns in the root than pixels."""
    measurements, count = _sizes(rng)
    kind = int(rng.integers(3))
    mean = np.full(count, MEAN)
    if kind == 0:
        prior = Prior(mean, np.where(rng.random(count) < 0.6, DEVIATION, 0.0))
    else:
        low_rank: FloatArray = DEVIATION * rng.normal(size=(count, int(rng.integers(1, count + 1))))
        prior = _centred(count) if kind == 1 else Prior(mean, low_rank)
    noise = np.where(rng.random(measurements) < 0.4, 0.0, _powers(rng, -24, 2, measurements))
    return drawn(rng.uniform(0, 1, (measurements, count)), prior, noise, rng)


def correlated_prior(rng: Generator) -> NastyProblem:
    """Exponential priors of long correlation, whose covariance is nearly singular."""
    shape = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    prior = exponential(MEAN, DEVIATION**2, shape, float(_powers(rng, -1, 6, 1)[0]))
    measurements = int(rng.integers(1, 7))
    noise = np.full(measurements, float(_powers(rng, -20, 2, 1)[0]))
    return drawn(rng.uniform(0, 1, (measurements, shape[0] * shape[1])), prior, noise, rng)


def large_mean(rng: Generator) -> NastyProblem:
    """A prior mean of up to 1e12 beside small deviations."""
    measurements, count = _sizes(rng)
    mean = np.full(count, float(_powers(rng, 0, 12, 1)[0]))
    noise = np.where(rng.random(measurements) < 0.3, 0.0, _powers(rng, -20, 4, measurements))
    deviation = _powers(rng, -2, 4, count)
    return drawn(rng.uniform(0, 1, (measurements, count)), Prior(mean, deviation), noise, rng)


def contradiction(rng: Generator) -> NastyProblem:
    """Repeated or dependent rows without noise whose readings may disagree."""
    count = int(rng.integers(1, 4))
    rows = rng.integers(0, 2, (int(rng.integers(1, 4)), count)).astype(np.float64)
    matrix = np.vstack([rows, rows[rng.integers(rows.shape[0], size=2)]])
    mean = float(rng.choice([0.0, MEAN, 1e4, 1e8, 1e10]))
    prior = Prior(np.full(count, mean), np.full(count, max(mean, DEVIATION)))
    nasty = drawn(matrix, prior, np.zeros(matrix.shape[0]), rng)
    size = float(rng.choice([0.0, 1e-12, 1e-3, 1.0]))
    recorded = nasty.recorded * (1 + size * rng.normal(size=nasty.recorded.size))
    if rng.random() < 0.3:
        recorded = rng.integers(1, 4, recorded.size).astype(np.float64)  # small readings beside a large mean
    return NastyProblem(nasty.problem, recorded)


def whole_numbers(rng: Generator) -> NastyProblem:
    """H of 0 and 1, of deficient rank, with noise in some of the measurements or in none."""
    measurements, count = _sizes(rng)
    noise = np.where(rng.random(measurements) < rng.choice([0.0, 0.5, 1.0]), 0.0, _powers(rng, -30, 4, measurements))
    return drawn(rng.integers(0, 2, (measurements, count)).astype(np.float64), _paper(count), noise, rng)


def scaled(rng: Generator) -> NastyProblem:
    """Rows, columns or entries of 1e-12 to 1e12."""
    measurements, count = _sizes(rng)
    by_rows, by_columns = _powers(rng, -12, 12, (measurements, 1)), _powers(rng, -12, 12, (1, count))
    factors = (by_rows, by_columns, _powers(rng, -12, 12, (measurements, count)), by_rows * by_columns)
    matrix = rng.uniform(-1, 1, (measurements, count)) * factors[int(rng.integers(4))]
    noise = np.full(measurements, float(_powers(rng, -30, 2, 1)[0]) * (rng.random() < 0.8))
    return drawn(matrix, _paper(count), noise, rng)


def hilbert(rng: Generator) -> NastyProblem:
    """Hilbert and Vandermonde matrices, nearly singular to the last digit."""
    count = int(rng.integers(2, 7))
    index = np.arange(count)
    matrix = 1 / (index[:, None] + index[None] + 1.0)
    if rng.random() < 0.5:
        matrix = np.vander(rng.uniform(0, 1, count), count)
    return drawn(matrix, _paper(count), np.full(count, float(_powers(rng, -28, 0, 1)[0])), rng)


def boxes(rng: Generator) -> NastyProblem:
    """Box averages of one to three lens types over a row of pixels, as a camera takes them."""
    count = int(rng.integers(4, 8))
    rows: list[FloatArray] = []
    for width in rng.choice([2, 3, 4], int(rng.integers(1, 4)), replace=False).tolist():
        for start in range(0, count - width + 1, int(rng.integers(1, width + 1))):
            rows.append(np.where((np.arange(count) >= start) & (np.arange(count) < start + width), 1 / width, 0.0))
    noise = np.full(len(rows), float(_powers(rng, -30, 2, 1)[0]) * (rng.random() < 0.7))
    prior = _paper(count) if rng.random() < 0.7 else exponential(MEAN, DEVIATION**2, (1, count), 3.0)
    return drawn(np.array(rows), prior, noise, rng)


FAMILIES: dict[str, Callable[[Generator], NastyProblem]] = {
    "nearly equal rows, noisy": nearly_equal_noisy,
    "nearly equal rows, noise-free": nearly_equal_exact,
    "extreme noise": extreme_noise,
    "wide noise": wide_noise,
    "denormal noise": denormal_noise,
    "extreme entries": extreme_entries,
    "extreme prior": extreme_prior,
    "singular prior": singular_prior,
    "correlated prior": correlated_prior,
    "large mean": large_mean,
    "contradiction": contradiction,
    "whole numbers": whole_numbers,
    "scaled": scaled,
    "hilbert": hilbert,
    "boxes": boxes,
}


def assess(family: str, seed: int) -> NastyOutcome:
    """Draw and solve one problem of a family, and compare the answer with the exact one."""
    try:
        nasty = FAMILIES[family](np.random.default_rng([seed, list(FAMILIES).index(family)]))
    except InputError as error:
        return NastyOutcome(family, seed, REFUSED, reason=str(error))
    try:
        solution = estimate(nasty.problem, nasty.recorded)
    except InputError as error:
        return NastyOutcome(family, seed, REFUSED, reason=str(error))
    except (np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
        return NastyOutcome(family, seed, SILENT, reason=f"{type(error).__name__}: {error}")
    problem, solver = nasty.problem, solution.solver
    variance = solution.form.variance()
    exact = exact_answer(problem, nasty.recorded)
    error = relative_error(solution.coefficients, exact.coefficients)
    variance_error = worst_relative_error(variance, exact.variance, NEGLIGIBLE_VARIANCE * problem.prior.variance)
    bound = float("nan") if solver.bound is None else solver.bound
    fine = _stated(error, bound) and _stated(variance_error, solver.variance_bound)
    fine = fine and exact.contradiction <= CONTRADICTION
    reason = f"{solver.method}, contradiction {exact.contradiction:.1e}"
    return NastyOutcome(
        family, seed, RIGHT if fine else SILENT, error, bound, variance_error, solver.variance_bound, reason
    )


def _stated(error: float, bound: float) -> bool:
    return error <= LEAST_ERROR or error <= ALLOWED_EXCESS * bound


def _counted(cell: Row) -> Row:
    """Assess a family from a seed to another: the numbers of its outcomes, and the silent losses in words."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [assess(cell["family"], seed) for seed in range(cell["start"], cell["stop"])]
    lost = [one for one in found if one.outcome == SILENT]
    words = [f"{one.family}, seed {one.seed}: {one.error:.1e}, stated {one.bound:.1e}" for one in lost]
    return {"counts": Counter(one.outcome for one in found), "losses": words}


def nasty_table(folder: Path, start: int = 0, each: int = EACH) -> Table:
    """Return the counts of a campaign by family, with the silent losses in the caption; `start` is its first seed.

    Every hundred seeds of a family are one line of `folder`/nasty.jsonl, which are not repeated.
    """
    begin = perf_counter()
    parts = [{"start": first, "stop": min(first + 100, start + each)} for first in range(start, start + each, 100)]
    cells: list[Row] = [{"family": name, **part} for name in FAMILIES for part in parts]
    rows = study(folder / "nasty.jsonl", cells, _counted)
    counts: dict[str, Counter[str]] = {name: Counter() for name in FAMILIES}
    for row in rows:
        counts[row["family"]] += Counter(row["counts"])
    losses = [loss for row in rows for loss in row["losses"]]
    table = Table(title=f"{each * len(counts)} problems that leave float64 few digits, against exact answers")
    for name in ("family", RIGHT, REFUSED, SILENT):
        table.add_column(name, justify="left" if name == "family" else "right")
    for name, count in [*counts.items(), ("all", sum(counts.values(), Counter[str]()))]:
        table.add_row(name, *(str(count[outcome]) for outcome in (RIGHT, REFUSED, SILENT)))
    table.caption = "\n".join([*losses[:20], f"Time of this call: {perf_counter() - begin:.0f} s."])
    return table


def command(words: list[str]) -> None:
    """Run or continue the campaign in the folder that is named, and print its table."""
    Console().print(nasty_table(Path(*words[:1] or ("nasty",))))
