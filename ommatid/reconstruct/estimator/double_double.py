"""Double-double arithmetic: a number is a pair `high + low` of float64 (Ogita, Rump and Oishi 2005).

The residuals of an estimate cancel almost completely; twice the precision leaves significant digits in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

UPPER_BITS = np.int64(-(2**27))  # mask of a float64's upper half: sign, exponent and 26 digits
ROUNDING = 2.0**-104  # relative rounding error of one operation


@dataclass(frozen=True)
class DoubleDouble:
    """The unevaluated sum of two arrays of the same shape; `low` is at most the rounding error of `high`."""

    high: FloatArray
    low: FloatArray

    def __add__(self, other: DoubleDouble) -> DoubleDouble:
        """Add element by element."""
        total, error = _two_sum(self.high, other.high)
        return _normalised(total, error + (self.low + other.low))

    def __sub__(self, other: DoubleDouble) -> DoubleDouble:
        """Subtract element by element."""
        return self + DoubleDouble(-other.high, -other.low)

    def scaled(self, factor: FloatArray) -> DoubleDouble:
        """Multiply element by element by a float64 array that broadcasts."""
        product, error = _two_product(self.high, factor)
        return _normalised(product, error + self.low * factor)


def exact(values: FloatArray) -> DoubleDouble:
    """Convert a float64 array without error."""
    return DoubleDouble(values, np.zeros_like(values))


def as_exact(values: FloatArray | DoubleDouble) -> DoubleDouble:
    """Return double-double numbers as they are, and convert a float64 array without error."""
    return values if isinstance(values, DoubleDouble) else exact(values)


@dataclass(frozen=True)
class SparseRows:
    """A matrix stored for `times`: (width, rows) `data` and the column `index` of each entry."""

    data: FloatArray
    index: NDArray[np.intp]

    def times(self, vector: DoubleDouble) -> DoubleDouble:
        """Multiply by a (columns, q) block: (rows, q)."""
        shape = (self.data.shape[1], vector.high.shape[1])
        total, rest = np.zeros(shape), np.zeros(shape)
        for data, index in zip(self.data, self.index, strict=True):
            factor = data[:, None]
            product, error = _two_product(vector.high[index], factor)
            total, lost = _two_sum(total, product)
            rest += lost + (error + vector.low[index] * factor)
        return _normalised(total, rest)


def column_dots(left: FloatArray, right: DoubleDouble) -> DoubleDouble:
    """Return the scalar products of the columns of two (n, q) blocks: (q,)."""
    total, rest = np.zeros((2, left.shape[1]))
    for a, high, low in zip(left, right.high, right.low, strict=True):
        product, error = _two_product(high, a)
        total, lost = _two_sum(total, product)
        rest += lost + (error + low * a)
    return _normalised(total, rest)


def sparse_rows(matrix: sparse.csr_array) -> SparseRows:
    """Store a sparse matrix; shorter rows are padded with zeros."""
    counts = np.diff(matrix.indptr)
    width = int(counts.max(initial=0))
    row = np.repeat(np.arange(counts.size), counts)
    position = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], counts)
    data = np.zeros((width, counts.size))
    index = np.zeros((width, counts.size), dtype=np.intp)
    data[position, row] = matrix.data
    index[position, row] = matrix.indices
    return SparseRows(data, index)


def _two_sum(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    total = a + b
    shadow = total - a
    return total, (a - (total - shadow)) + (b - shadow)


def _normalised(high: FloatArray, low: FloatArray) -> DoubleDouble:
    total = high + low
    return DoubleDouble(total, low - (total - high))


def _split(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    # By bit mask: the usual multiplication by 2^27 + 1 overflows for the largest numbers.
    high = (np.ascontiguousarray(values).view(np.int64) & UPPER_BITS).view(np.float64)
    return high, values - high


def _two_product(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    product = a * b
    a_high, a_low = _split(a)
    b_high, b_low = _split(b)
    return product, a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low)
