"""Sums and products in twice the precision of float64: a number is a pair `high + low` (Ogita, Rump and Oishi 2005).

Residuals of an estimate cancel almost wholly; computed so, what is left of them can be believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]

UPPER = np.int64(-(2**27))  # the bits of a number that its upper half keeps: sign, exponent and 26 digits
ROUNDING = 2.0**-104  # relative, of one operation


@dataclass(frozen=True)
class DoubleDouble:
    """The unevaluated sum of two arrays of one shape; `low` is at most rounding of `high`."""

    high: Array
    low: Array

    def __add__(self, other: DoubleDouble) -> DoubleDouble:
        """Sum, element by element."""
        total, error = _sum(self.high, other.high)
        return _normal(total, error + (self.low + other.low))

    def __sub__(self, other: DoubleDouble) -> DoubleDouble:
        """Difference, element by element."""
        return self + DoubleDouble(-other.high, -other.low)

    def scaled(self, factor: Array) -> DoubleDouble:
        """Product with an array that broadcasts, element by element."""
        product, error = _product(self.high, factor)
        return _normal(product, error + self.low * factor)


def exact(values: Array) -> DoubleDouble:
    """A float64 array as it is."""
    return DoubleDouble(values, np.zeros_like(values))


@dataclass(frozen=True)
class SparseRows:
    """A matrix laid out for `times`: (width, rows) `data`, and which element of the vector each of them meets."""

    data: Array
    index: NDArray[np.intp]

    def times(self, vector: DoubleDouble) -> DoubleDouble:
        """The matrix times (columns, q): (rows, q)."""
        shape = (self.data.shape[1], vector.high.shape[1])
        total, rest = np.zeros(shape), np.zeros(shape)
        for data, index in zip(self.data, self.index, strict=True):
            factor = data[:, None]
            product, error = _product(vector.high[index], factor)
            total, lost = _sum(total, product)
            rest += lost + (error + vector.low[index] * factor)
        return _normal(total, rest)


def dots(left: Array, right: DoubleDouble) -> DoubleDouble:
    """Scalar products of columns, (n, q) each: (q,)."""
    total, rest = np.zeros((2, left.shape[1]))
    for a, high, low in zip(left, right.high, right.low, strict=True):
        product, error = _product(high, a)
        total, lost = _sum(total, product)
        rest += lost + (error + low * a)
    return _normal(total, rest)


def rows_of(matrix: sparse.csr_array) -> SparseRows:
    """Lay out a sparse matrix; shorter rows are filled up with zeros."""
    counts = np.diff(matrix.indptr)
    width = int(counts.max(initial=0))
    row = np.repeat(np.arange(counts.size), counts)
    place = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], counts)
    data = np.zeros((width, counts.size))
    index = np.zeros((width, counts.size), dtype=np.intp)
    data[place, row] = matrix.data
    index[place, row] = matrix.indices
    return SparseRows(data, index)


def rows_of_dense(matrix: Array) -> SparseRows:
    """Lay out a dense matrix."""
    count = np.arange(matrix.shape[1], dtype=np.intp)
    columns = np.repeat(count[:, None], matrix.shape[0], axis=1)
    return SparseRows(np.ascontiguousarray(matrix.T), columns)


def _sum(a: Array, b: Array) -> tuple[Array, Array]:
    total = a + b
    shadow = total - a
    return total, (a - (total - shadow)) + (b - shadow)


def _normal(high: Array, low: Array) -> DoubleDouble:
    total = high + low
    return DoubleDouble(total, low - (total - high))


def _split(values: Array) -> tuple[Array, Array]:
    # By its bits: the usual multiplication by 2^27 + 1 would overflow for numbers that do not.
    high = (np.ascontiguousarray(values).view(np.int64) & UPPER).view(np.float64)
    return high, values - high


def _product(a: Array, b: Array) -> tuple[Array, Array]:
    product = a * b
    a_high, a_low = _split(a)
    b_high, b_low = _split(b)
    return product, a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low)
