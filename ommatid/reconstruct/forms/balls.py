"""Matrices of balls, numbers with an error bound (Johansson 2017), and of residues modulo a prime.

Balls decide no equality; residues do: a number other than 0 is divisible by the prime with probability 1e-18.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray

from ..prior import Prior

PRIME = 2**61 - 1
RADIUS = 1e-34  # of a result, relative to it: below the rounding of two float64
LEAST_FLOAT = 2.0**-1074  # the smallest float64 above 0


def balls(values: FloatArray) -> Any:
    """Convert a float64 matrix without error."""
    import flint

    arb_mat: Any = flint.arb_mat
    return arb_mat(*values.shape, values.ravel().tolist())


def ball_matrix(entries: list[list[Any]]) -> Any:
    """Return a matrix of balls from its rows."""
    import flint

    arb_mat: Any = flint.arb_mat
    return arb_mat(entries)


def column(entries: list[Any]) -> Any:
    """Return a matrix of one column of balls."""
    import flint

    arb_mat: Any = flint.arb_mat
    return arb_mat(len(entries), 1, entries)


def product_diagonal(left: Any, right: Any) -> list[Any]:
    """Return the diagonal of a matrix times the transpose of another."""
    inner = range(left.ncols())
    return [sum(left[index, between] * right[index, between] for between in inner) for index in range(left.nrows())]


def relative_misfit(matrix: Any, image: Any, measured: Any, row: int) -> float:
    """Return |g - H f|_i / (|g| + |H| |f|)_i of one row, 0 where both are 0: f and g are columns."""
    terms = [matrix[row, index] * image[index, 0] for index in range(matrix.ncols())]
    reading = measured[row, 0]
    size = (abs(reading) + sum(abs(term) for term in terms)).mid()
    return float(abs((reading - sum(terms)).mid()) / size) if size > 0 else 0.0


def negligible_radii(matrix: Any, *, elementwise: bool) -> bool:
    """Return True if radii are negligible: relative to their column or to every number, or where a float64 is 0."""
    width = matrix.ncols()
    entries = matrix.entries()
    size = [abs(entry.mid()) for entry in entries]
    if not elementwise:
        largest = [max(size[index::width], default=0) for index in range(width)]
        size = [largest[place % width] for place in range(len(size))]
    return all(
        bool(entry.rad() <= limit * RADIUS) or bool(entry.rad() <= LEAST_FLOAT)
        for entry, limit in zip(entries, size, strict=True)
    )


def floats(matrix: Any) -> tuple[FloatArray, FloatArray]:
    """Return the middles of balls, each as the sum of two float64."""
    shape = matrix.nrows(), matrix.ncols()
    high = np.array([float(entry.mid()) for entry in matrix.entries()]).reshape(shape)
    if not np.isfinite(high).all():
        return high, np.zeros(shape)
    low = [float((entry - top).mid()) for entry, top in zip(matrix.entries(), high.ravel().tolist(), strict=True)]
    return high, np.array(low).reshape(shape)


def dense_root(prior: Prior) -> FloatArray:
    """Return L as a matrix: (N, K)."""
    return np.diag(prior.root) if prior.independent else prior.root


def independent_rows(matrix: FloatArray, root: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of a product that are not 0, and the first linearly independent ones."""
    if not matrix.shape[0]:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    product = _residues(matrix) * _residues(root)
    signal = [index for index, row in enumerate(product.tolist()) if any(int(entry) for entry in row)]
    reduced, rank = product.transpose().rref()
    table: Sequence[Sequence[Any]] = reduced.tolist()
    basis = [next(index for index, entry in enumerate(table[row]) if int(entry)) for row in range(rank)]
    return np.array(signal, dtype=np.intp), np.array(basis, dtype=np.intp)


def _residues(values: FloatArray) -> Any:
    import flint

    nmod_mat: Any = flint.nmod_mat
    ratios = (value.as_integer_ratio() for value in values.ravel().tolist())
    return nmod_mat(*values.shape, [top * pow(bottom, -1, PRIME) % PRIME for top, bottom in ratios], PRIME)
