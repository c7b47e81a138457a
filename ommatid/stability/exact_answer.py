"""The exact answer of Eq. 4 and the exact posterior variances, by which the forms of the estimator are judged.

The float64 numbers of a problem are taken as the rationals that they are. With D = H P0 and C = D H^T + Rv,

    f^ = f0 + D^T C^-1 (g - H f0),    variance_i = (P0 - D^T C^-1 D)_ii,

the textbook's covariance form, which loses every digit in float64. Here it is computed twice: in balls (Johansson 2017)
of more and more bits, until every radius is below 1e-30 of its number; and modulo a prime of 61 bits, which tells what
no ball can decide: which rows depend on others, and which numbers are zeros. That a number other than 0 is divisible by
the prime happens by chance of 1e-18. Time and memory are for a hundred pixels, not for a thousand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.problem import Problem

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Ring = Callable[[Matrix], Any]  # makes a matrix of its kind of numbers from one of float64

PRIME = 2**61 - 1
RADIUS = 1e-30
LEAST_BITS, MOST_BITS = 512, 16384


@dataclass(frozen=True)
class Accurate:
    """(n,) numbers to 30 digits, each the sum of two float64, `high + low`."""

    high: Vector
    low: Vector

    def away(self, computed: Vector) -> Vector:
        """`computed` minus these numbers, element by element, without cancellation."""
        return (computed - self.high) - self.low


@dataclass(frozen=True)
class ExactAnswer:
    """The exact u, (K,), as `freedoms`, `image` f0 + L u, (N,), and posterior `variance`, (N,), and the bits it took.

    Where measurements without noise contradict one another it is the limit of little noise in proportion to the signal
    |(H L)_i| of each; `contradiction` is the largest |g - H f^|_i / (|g| + |H| |f^|)_i that is left among them.
    """

    freedoms: Accurate
    image: Accurate
    variance: Accurate
    contradiction: float
    bits: int


@dataclass(frozen=True)
class _Rows:
    """Rows of H L: those that suffice; of those without noise the ones with a signal, and a basis of these.

    columns : as many columns as the basis has rows, independent in it
    """

    kept: list[int]
    quiet: list[int]
    basis: list[int]
    columns: list[int]


@dataclass(frozen=True)
class _Answer:
    """u, f^, the variances and g - H f^ in one kind of numbers."""

    freedoms: list[Any]
    image: list[Any]
    variance: list[Any]
    left: list[Any]


def exact_answer(problem: Problem, recorded: Vector) -> ExactAnswer:
    """The exact answer to g, (M,) `recorded`. Raises ArithmeticError where 16384 bits do not suffice."""
    from flint import ctx

    rows = _sorted_rows(problem)
    zeros = _answer(_residues, problem, recorded, rows)
    before, bits = ctx.prec, LEAST_BITS
    try:
        while bits <= MOST_BITS:
            ctx.prec = bits
            found = _answer_in_balls(problem, recorded, rows, zeros, bits)
            if found is not None:
                return found
            bits *= 2
    finally:
        ctx.prec = before
    raise ArithmeticError(f"{MOST_BITS} bits do not give the exact answer")


def _residues(values: Matrix) -> Any:
    import flint

    nmod_mat: Any = flint.nmod_mat
    ratios = (value.as_integer_ratio() for value in values.ravel().tolist())
    return nmod_mat(*values.shape, [top * pow(bottom, -1, PRIME) % PRIME for top, bottom in ratios], PRIME)


def _balls(values: Matrix) -> Any:
    import flint

    arb_mat: Any = flint.arb_mat
    return arb_mat(*values.shape, values.ravel().tolist())


def _sorted_rows(problem: Problem) -> _Rows:
    observed = _residues(problem.matrix.toarray()) * _residues(_dense_root(problem))
    signal = np.array([any(int(entry) for entry in row) for row in observed.tolist()], dtype=bool)
    noisy = np.flatnonzero(signal & (problem.noise_variance > 0)).tolist()
    quiet = np.flatnonzero(signal & (problem.noise_variance == 0)).tolist()
    basis = [quiet[place] for place in _pivots(_some(observed, quiet).transpose())]
    return _Rows(noisy + basis, quiet, basis, _pivots(_some(observed, basis)))


def _answer(ring: Ring, problem: Problem, recorded: Vector, rows: _Rows) -> _Answer:
    """The formulas above. Raises ZeroDivisionError where balls are too wide to divide by."""
    matrix, root, mean = ring(problem.matrix.toarray()), ring(_dense_root(problem)), ring(problem.prior.mean[:, None])
    given, noise = ring(recorded[:, None]), ring(problem.noise_variance[:, None])
    observed = matrix * root
    away = _agreed(observed, given - matrix * mean, rows)
    kept = _some(observed, rows.kept)
    innovation = kept * kept.transpose()
    for place, row in enumerate(rows.kept):
        innovation[place, place] += noise[row, 0]
    shared = kept * root.transpose()
    told = _diagonal(shared.transpose(), innovation.solve(shared))
    variance = [prior - less for prior, less in zip(_diagonal(root, root.transpose()), told, strict=True)]
    freedoms = kept.transpose() * innovation.solve(away)
    image = mean + root * freedoms
    return _Answer(freedoms.entries(), image.entries(), variance, (given - matrix * image).entries())


def _agreed(observed: Any, away: Any, rows: _Rows) -> Any:
    """g - H f0 in the rows that are kept; those without noise are first made to agree, by least squares."""
    agreed = _some(away, rows.kept)
    if len(rows.quiet) == len(rows.basis):
        return agreed
    quiet = _some(observed, rows.quiet)
    across = _some(quiet.transpose(), rows.columns)
    spanning = across.transpose()
    for place, size in enumerate(_diagonal(quiet, quiet.transpose())):
        for column in range(across.nrows()):
            across[column, place] /= size
    best = (across * spanning).solve(across * _some(away, rows.quiet))
    fitted = _some(_some(observed, rows.basis).transpose(), rows.columns).transpose() * best
    first = len(rows.kept) - len(rows.basis)
    for place in range(len(rows.basis)):
        agreed[first + place, 0] = fitted[place, 0]
    return agreed


def _answer_in_balls(problem: Problem, recorded: Vector, rows: _Rows, zeros: _Answer, bits: int) -> ExactAnswer | None:
    """The answer with the bits that are set, None if they are too few."""
    try:
        found = _answer(_balls, problem, recorded, rows)
    except ZeroDivisionError:
        return None
    freedoms = _accurate(found.freedoms, zeros.freedoms, together=True)
    image = _accurate(found.image, zeros.image, together=True)
    variance = _accurate(found.variance, zeros.variance, together=False)
    if freedoms is None or image is None or variance is None:
        return None
    left = np.array([0.0 if int(zero) == 0 else float(ball.mid()) for ball, zero in _pairs(found.left, zeros.left)])
    size = np.abs(recorded) + abs(problem.matrix) @ np.abs(image.high)
    relative = np.divide(np.abs(left), size, out=np.zeros_like(size), where=(problem.noise_variance == 0) & (size > 0))
    return ExactAnswer(freedoms, image, variance, float(relative.max(initial=0.0)), bits)


def _accurate(balls: list[Any], residues: list[Any], *, together: bool) -> Accurate | None:
    """The balls' middles, None where radii are too large beside their norm (`together`) or beside one of them."""
    high, low, radius = np.zeros((3, len(balls)))
    for place, (ball, residue) in enumerate(_pairs(balls, residues)):
        if int(residue) == 0:
            continue
        high[place] = float(ball.mid())
        low[place] = float((ball - high[place]).mid())
        radius[place] = float(ball.rad())
    size = np.abs(high)
    sharp = radius.max() <= RADIUS * size.max() if together else radius <= RADIUS * size
    return Accurate(high, low) if np.all(sharp) else None


def _pairs(balls: list[Any], residues: list[Any]) -> zip[tuple[Any, Any]]:
    return zip(balls, residues, strict=True)


def _dense_root(problem: Problem) -> Matrix:
    root = problem.prior.root
    return np.diag(root) if problem.prior.independent else root


def _pivots(matrix: Any) -> list[int]:
    """The first columns that are independent."""
    reduced, rank = matrix.rref()
    table = reduced.tolist()
    return [next(column for column, entry in enumerate(table[row]) if int(entry)) for row in range(rank)]


def _some(matrix: Any, rows: list[int]) -> Any:
    """Some rows of a matrix, in the order asked for."""
    table = matrix.tolist()
    modulus = (PRIME,) if hasattr(matrix, "modulus") else ()
    return type(matrix)(len(rows), matrix.ncols(), [entry for row in rows for entry in table[row]], *modulus)


def _diagonal(left: Any, right: Any) -> list[Any]:
    """The diagonal of a product."""
    inner = range(left.ncols())
    return [sum(left[place, between] * right[between, place] for between in inner) for place in range(left.nrows())]
