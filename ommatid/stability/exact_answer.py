"""The exact answer of Eq. 4 and the exact posterior variances, as a reference for the forms of the estimator.

The float64 numbers of a problem are taken as the rationals that they are. With D = H P0 and C = D H^T + Rv,

    f^ = f0 + D^T C^-1 (g - H f0),    variance_i = (P0 - D^T C^-1 D)_ii,

the textbook covariance form, which loses every digit in float64. Here it is evaluated twice: in ball arithmetic
(Johansson 2017) of increasing precision, until every radius is below 1e-30 of its number; and modulo a prime of 61
bits, which decides what balls cannot: which rows are linearly dependent, and which numbers are 0. A number other than 0
is divisible by the prime with probability 1e-18. Time and memory suffice for about a hundred pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import norm

from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray

Ring = Callable[[FloatArray], Any]  # converts a float64 matrix to a matrix over a ring

PRIME = 2**61 - 1
RADIUS = 1e-30
LEAST_BITS, MOST_BITS = 512, 16384


@dataclass(frozen=True)
class ExactNumbers:
    """(n,) numbers to 30 digits, each the sum of two float64, `high + low`."""

    high: FloatArray
    low: FloatArray

    def difference(self, computed: FloatArray) -> FloatArray:
        """Return `computed` minus these numbers without cancellation error."""
        return (computed - self.high) - self.low


@dataclass(frozen=True)
class ExactAnswer:
    """The exact u, (K,), as `coefficients`, the `image` f0 + L u, (N,), and the posterior `variance`, (N,).

    If measurements without noise contradict one another, this is the limit of small noise proportional to the signal
    |(H L)_i| of each; `contradiction` is the largest remaining |g - H f^|_i / (|g| + |H| |f^|)_i among them.
    """

    coefficients: ExactNumbers
    image: ExactNumbers
    variance: ExactNumbers
    contradiction: float


@dataclass(frozen=True)
class _Rows:
    """Rows of H L: a sufficient set; those without noise but with signal, and a basis of them.

    columns : as many linearly independent columns of the basis as it has rows
    """

    sufficient: list[int]
    noise_free: list[int]
    basis: list[int]
    columns: list[int]


@dataclass(frozen=True)
class _Answer:
    """u, f^, the variances and g - H f^ over one ring."""

    coefficients: list[Any]
    image: list[Any]
    variance: list[Any]
    misfit: list[Any]


def relative_error(computed: FloatArray, exact: ExactNumbers) -> float:
    """Return |computed - exact| / |exact| of two vectors; infinite where that is no number."""
    difference, size = norm(exact.difference(computed), check_finite=False), norm(exact.high)
    return float(difference / size) if size and np.isfinite(difference) else (float("inf") if difference else 0.0)


def worst_relative_error(computed: FloatArray, exact: ExactNumbers, negligible: FloatArray) -> float:
    """Return the largest |computed - exact| / exact of a set of variances.

    negligible : (N,); a variance of 0 is right if the exact one is smaller than this
    """
    if not np.isfinite(computed).all() or (computed < 0).any():
        return float("inf")
    error = np.abs(exact.difference(computed))
    error[((computed == 0) | (exact.high == 0)) & (error <= negligible)] = 0
    with np.errstate(divide="ignore"):
        return float(np.divide(error, exact.high, out=np.zeros_like(error), where=error > 0).max(initial=0.0))


def exact_answer(problem: Problem, recorded: FloatArray) -> ExactAnswer:
    """Return the exact answer for g, (M,) `recorded`. Raises ArithmeticError if 16384 bits do not suffice."""
    from flint import ctx

    rows = _classified_rows(problem)
    residues = _answer(_residues, problem, recorded, rows)
    before, bits = ctx.prec, LEAST_BITS
    try:
        while bits <= MOST_BITS:
            ctx.prec = bits
            answer = _answer_in_balls(problem, recorded, rows, residues)
            if answer is not None:
                return answer
            bits *= 2
    finally:
        ctx.prec = before
    raise ArithmeticError(f"{MOST_BITS} bits do not suffice for the exact answer")


def _residues(values: FloatArray) -> Any:
    import flint

    nmod_mat: Any = flint.nmod_mat
    ratios = (value.as_integer_ratio() for value in values.ravel().tolist())
    return nmod_mat(*values.shape, [top * pow(bottom, -1, PRIME) % PRIME for top, bottom in ratios], PRIME)


def _balls(values: FloatArray) -> Any:
    import flint

    arb_mat: Any = flint.arb_mat
    return arb_mat(*values.shape, values.ravel().tolist())


def _classified_rows(problem: Problem) -> _Rows:
    matrix = _residues(problem.matrix.toarray()) * _residues(_dense_root(problem))
    signal = np.array([any(int(entry) for entry in row) for row in matrix.tolist()], dtype=bool)
    noisy = np.flatnonzero(signal & (problem.noise_variance > 0)).tolist()
    noise_free = np.flatnonzero(signal & (problem.noise_variance == 0)).tolist()
    basis = [noise_free[index] for index in _pivots(_row_subset(matrix, noise_free).transpose())]
    return _Rows(noisy + basis, noise_free, basis, _pivots(_row_subset(matrix, basis)))


def _answer(ring: Ring, problem: Problem, recorded: FloatArray, rows: _Rows) -> _Answer:
    """Evaluate the formulas above. Raises ZeroDivisionError if balls are too wide to divide by."""
    matrix, root, mean = ring(problem.matrix.toarray()), ring(_dense_root(problem)), ring(problem.prior.mean[:, None])
    measured, noise = ring(recorded[:, None]), ring(problem.noise_variance[:, None])
    rooted = matrix * root
    residual = _consistent(rooted, measured - matrix * mean, rows)
    sufficient = _row_subset(rooted, rows.sufficient)
    innovation = sufficient * sufficient.transpose()
    for index, row in enumerate(rows.sufficient):
        innovation[index, index] += noise[row, 0]
    cross = sufficient * root.transpose()
    explained = _product_diagonal(cross.transpose(), innovation.solve(cross))
    prior = _product_diagonal(root, root.transpose())
    variance = [before - less for before, less in zip(prior, explained, strict=True)]
    coefficients = sufficient.transpose() * innovation.solve(residual)
    image = mean + root * coefficients
    return _Answer(coefficients.entries(), image.entries(), variance, (measured - matrix * image).entries())


def _consistent(matrix: Any, residual: Any, rows: _Rows) -> Any:
    """g - H f0 in the sufficient rows; those without noise are first made consistent by least squares."""
    consistent = _row_subset(residual, rows.sufficient)
    if len(rows.noise_free) == len(rows.basis):
        return consistent
    noise_free = _row_subset(matrix, rows.noise_free)
    weighted = _row_subset(noise_free.transpose(), rows.columns)
    spanning = weighted.transpose()
    for index, size in enumerate(_product_diagonal(noise_free, noise_free.transpose())):
        for column in range(weighted.nrows()):
            weighted[column, index] /= size
    solution = (weighted * spanning).solve(weighted * _row_subset(residual, rows.noise_free))
    fitted = _row_subset(_row_subset(matrix, rows.basis).transpose(), rows.columns).transpose() * solution
    first = len(rows.sufficient) - len(rows.basis)
    for index in range(len(rows.basis)):
        consistent[first + index, 0] = fitted[index, 0]
    return consistent


def _answer_in_balls(problem: Problem, recorded: FloatArray, rows: _Rows, residues: _Answer) -> ExactAnswer | None:
    """Return the answer at the current precision, None if it is too low."""
    try:
        balls = _answer(_balls, problem, recorded, rows)
    except ZeroDivisionError:
        return None
    coefficients = _exact_numbers(balls.coefficients, residues.coefficients, norm=True)
    image = _exact_numbers(balls.image, residues.image, norm=True)
    variance = _exact_numbers(balls.variance, residues.variance, norm=False)
    if coefficients is None or image is None or variance is None:
        return None
    misfit = np.array(
        [
            0.0 if int(residue) == 0 else float(ball.mid())
            for ball, residue in zip(balls.misfit, residues.misfit, strict=True)
        ]
    )
    size = np.abs(recorded) + abs(problem.matrix) @ np.abs(image.high)
    compared = (problem.noise_variance == 0) & (size > 0)
    relative = np.divide(np.abs(misfit), size, out=np.zeros_like(size), where=compared)
    return ExactAnswer(coefficients, image, variance, float(relative.max(initial=0.0)))


def _exact_numbers(balls: list[Any], residues: list[Any], *, norm: bool) -> ExactNumbers | None:
    """Return the midpoints, None if radii are too large relative to the norm of all (`norm`) or to one of them."""
    high, low, radius = np.zeros((3, len(balls)))
    for index, (ball, residue) in enumerate(zip(balls, residues, strict=True)):
        if int(residue) == 0:
            continue
        high[index] = float(ball.mid())
        low[index] = float((ball - high[index]).mid())
        radius[index] = float(ball.rad())
    size = np.abs(high)
    accurate = radius.max() <= RADIUS * size.max() if norm else radius <= RADIUS * size
    return ExactNumbers(high, low) if np.all(accurate) else None


def _dense_root(problem: Problem) -> FloatArray:
    root = problem.prior.root
    return np.diag(root) if problem.prior.independent else root


def _pivots(matrix: Any) -> list[int]:
    """Return the first linearly independent columns."""
    reduced, rank = matrix.rref()
    table = reduced.tolist()
    return [next(column for column, entry in enumerate(table[row]) if int(entry)) for row in range(rank)]


def _row_subset(matrix: Any, rows: list[int]) -> Any:
    """Return rows of a matrix in the given order."""
    table = matrix.tolist()
    modulus = (PRIME,) if hasattr(matrix, "modulus") else ()
    return type(matrix)(len(rows), matrix.ncols(), [entry for row in rows for entry in table[row]], *modulus)


def _product_diagonal(left: Any, right: Any) -> list[Any]:
    """Return the diagonal of a matrix product."""
    inner = range(left.ncols())
    return [sum(left[index, between] * right[between, index] for between in inner) for index in range(left.nrows())]
