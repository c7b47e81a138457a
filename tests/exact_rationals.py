"""Eq. 4 and 5 in rational numbers: the reference for problems that leave float64 few digits or none.

The float64 numbers of a problem are taken as the rationals that they are, and no number is rounded on the way.
With B = H L, r = g - H f0 and C = B B^T + Rv over the measurements with noise and a basis of those without,

    u = B^T C^-1 r,    variance_i = |L_i|^2 - (L B^T)_i C^-1 (B L^T)_i.

Nothing here is shared with the estimator or with `ommatid.stability.exact_answer`, which uses balls and residues.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray

Rationals = list[Fraction]


@dataclass(frozen=True)
class RationalAnswer:
    """The exact u, (K,), and posterior variances, (N,), and by how much measurements without noise contradict.

    contradiction : largest |g - H f^|_i / (|g| + |H| |f^|)_i of the measurements without noise; 0 if they agree
    """

    coefficients: Rationals
    variance: Rationals
    contradiction: float


def rational_answer(problem: Problem, recorded: FloatArray, order: Sequence[int] | None = None) -> RationalAnswer:
    """Return the exact answer for g, (M,) `recorded`.

    order : of the measurements; where those without noise contradict one another, the first ones are met
    """
    rows = list(range(problem.measurements)) if order is None else list(order)
    root = np.diag(problem.prior.root) if problem.prior.independent else problem.prior.root
    matrix, roots = _rationals(problem.matrix.toarray()[rows]), _rationals(root)
    measured, mean = _rationals(recorded[rows, None]), _rationals(problem.prior.mean[:, None])
    whole, right = matrix * roots, measured - matrix * mean
    kept = _sufficient(whole, problem.noise_variance[rows])
    observed, noise = _rows(whole, kept), _rationals(problem.noise_variance[rows][kept, None])
    innovation = observed * observed.transpose()
    for index in range(len(kept)):
        innovation[index, index] += noise[index, 0]
    cross = observed * roots.transpose()
    gain = _solve(innovation, cross)
    coefficients = observed.transpose() * _solve(innovation, _rows(right, kept))
    variance = [
        sum((roots[i, k] ** 2 for k in range(roots.ncols())), start=roots[0, 0] * 0)
        - sum((cross[j, i] * gain[j, i] for j in range(len(kept))), start=roots[0, 0] * 0)
        for i in range(roots.nrows())
    ]
    image = mean + roots * coefficients
    return RationalAnswer(
        [_fraction(coefficients[k, 0]) for k in range(coefficients.nrows())],
        [_fraction(value) for value in variance],
        _contradiction(matrix, measured, image, problem.noise_variance[rows]),
    )


def relative_error(computed: FloatArray, exact: Rationals) -> float:
    """Return |computed - exact| / |exact| of two vectors; infinite unless all numbers are finite."""
    if not np.isfinite(computed).all():
        return float("inf")
    difference = sum((Fraction(value) - right) ** 2 for value, right in zip(computed.tolist(), exact, strict=True))
    return _ratio_root(difference, sum((right**2 for right in exact), start=Fraction(0)))


def worst_relative_error(computed: FloatArray, exact: Rationals, negligible: FloatArray) -> float:
    """Return the largest |computed - exact| / exact of a set of variances.

    negligible : (N,); a variance of 0 is right if the exact one is smaller than this
    """
    if not np.isfinite(computed).all() or (computed < 0).any():
        return float("inf")
    worst = 0.0
    for value, right, least in zip(computed.tolist(), exact, negligible.tolist(), strict=True):
        error = abs(Fraction(value) - right)
        if error > (Fraction(least) if value == 0 or right == 0 else 0):
            worst = max(worst, _ratio_root(error**2, right**2))
    return worst


def _ratio_root(top: Fraction | int, bottom: Fraction | int) -> float:
    """Return sqrt(top / bottom), infinite if only the denominator is 0."""
    if not bottom:
        return float("inf") if top else 0.0
    ratio = Fraction(top) / Fraction(bottom)
    if ratio > Fraction(10) ** 300:
        return float("inf")
    return float(ratio) ** 0.5 if ratio > Fraction(10) ** -300 else 0.0


def _rationals(values: FloatArray) -> Any:
    import flint

    fmpq: Any = flint.fmpq
    fmpq_mat: Any = flint.fmpq_mat
    entries = [fmpq(*value.as_integer_ratio()) for value in values.ravel().tolist()]
    return fmpq_mat(*values.shape, entries)


def _fraction(value: Any) -> Fraction:
    return Fraction(int(value.p), int(value.q))


def _rows(matrix: Any, rows: Sequence[int]) -> Any:
    table = matrix.tolist()
    return type(matrix)(len(rows), matrix.ncols(), [entry for row in rows for entry in table[row]])


def _solve(matrix: Any, right: Any) -> Any:
    return matrix.solve(right) if matrix.nrows() else right


def _sufficient(whole: Any, noise: FloatArray) -> list[int]:
    """Return the measurements with noise, and the first independent ones of those without."""
    noisy, free = np.flatnonzero(noise > 0).tolist(), np.flatnonzero(noise == 0).tolist()
    if not free:
        return noisy
    reduced, rank = _rows(whole, free).transpose().rref()
    table = reduced.tolist()
    pivots = [next(column for column, entry in enumerate(table[row]) if entry != 0) for row in range(rank)]
    return noisy + [free[index] for index in pivots]


def _contradiction(matrix: Any, measured: Any, image: Any, noise: FloatArray) -> float:
    worst = 0.0
    for row in np.flatnonzero(noise == 0).tolist():
        terms = [_fraction(matrix[row, column] * image[column, 0]) for column in range(matrix.ncols())]
        reading = _fraction(measured[row, 0])
        size = abs(reading) + sum(abs(term) for term in terms)
        if size:
            worst = max(worst, float(abs(reading - sum(terms)) / size))
    return worst
