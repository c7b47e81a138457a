"""Residuals of the estimator's equations in double-double arithmetic.

For right-hand sides c and r (`problem`) and a computed solution u and l,

    p = c + L^T H^T l - u,    q = r - H L u - Rv l.

Both cancel almost completely; float64 would leave little but rounding error. A double-double number is a pair
`high + low` of float64 (Ogita, Rump and Oishi 2005), which leaves significant digits in them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import FloatArray

from ..prior import Prior
from ..problem import Problem

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


@dataclass(frozen=True)
class ExactResiduals:
    """The matrices of a problem, stored for products in double-double arithmetic."""

    problem: Problem

    @cached_property
    def _matrix(self) -> SparseRows:
        return sparse_rows(self.problem.matrix)

    @cached_property
    def _transposed(self) -> SparseRows:
        return sparse_rows(sparse.csr_array(self.problem.matrix.T))

    @cached_property
    def _root(self) -> tuple[SparseRows, SparseRows]:
        root = self.problem.prior.root
        return sparse_rows(sparse.csr_array(root)), sparse_rows(sparse.csr_array(root.T))

    @cached_property
    def _magnitudes(self) -> tuple[sparse.csr_array, Prior]:
        """|H|, and the prior with |L|."""
        prior = self.problem.prior
        return abs(self.problem.matrix), Prior(prior.mean, np.abs(prior.root))

    @property
    def rounding(self) -> float:
        """Relative rounding error of the residuals, from the number of terms in their longest sum."""
        longest = max(self._matrix.data.shape[0], self._transposed.data.shape[0])
        return ROUNDING * (4 + longest + (0 if self.problem.prior.independent else self.problem.prior.dimension))

    @cached_property
    def signal(self) -> FloatArray:
        """An upper bound on the norm of every row of H L: (M,)."""
        matrix, prior = self._magnitudes
        return np.asarray(matrix @ np.sqrt(prior.variance))

    def forward(self, coefficients: DoubleDouble) -> DoubleDouble:
        """Apply H L."""
        return self._matrix.times(self.root(coefficients))

    def adjoint(self, measurements: DoubleDouble) -> DoubleDouble:
        """Apply L^T H^T."""
        return self.root_transposed(self._transposed.times(measurements))

    def root(self, coefficients: DoubleDouble) -> DoubleDouble:
        """Apply L."""
        prior = self.problem.prior
        return coefficients.scaled(prior.root[:, None]) if prior.independent else self._root[0].times(coefficients)

    def root_transposed(self, image: DoubleDouble) -> DoubleDouble:
        """Apply L^T."""
        prior = self.problem.prior
        return image.scaled(prior.root[:, None]) if prior.independent else self._root[1].times(image)

    def recorded(self, values: FloatArray) -> DoubleDouble:
        """Return g - H f0: (M, 1)."""
        return exact(values[:, None]) - self._matrix.times(exact(self.problem.prior.mean[:, None]))

    def residuals(
        self, u: DoubleDouble, multipliers: DoubleDouble, shift: DoubleDouble, recorded: DoubleDouble
    ) -> tuple[DoubleDouble, DoubleDouble]:
        """Return p, (K, q), and q, (M, q), of the module docstring."""
        noise = self.problem.noise_variance[:, None]
        return shift + self.adjoint(multipliers) - u, recorded - self.forward(u) - multipliers.scaled(noise)

    def rounding_errors(
        self, u: FloatArray, multipliers: FloatArray, shift: FloatArray, recorded: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return bounds on the rounding errors of p and q, from the magnitudes of the terms of their sums."""
        matrix, prior = self._magnitudes
        u, multipliers = np.abs(u), np.abs(multipliers)
        p = np.abs(shift) + prior.apply_root_transposed(matrix.T @ multipliers) + u
        q = np.abs(recorded) + matrix @ prior.apply_root(u) + self.problem.noise_variance[:, None] * multipliers
        return self.rounding * p, self.rounding * q

    def image(self, u: DoubleDouble) -> DoubleDouble:
        """Return f0 + L u, (N, 1), of u, (K, 1)."""
        return exact(self.problem.prior.mean[:, None]) + self.root(u)

    def contradiction(self, recorded: FloatArray, u: DoubleDouble) -> float:
        """Return the largest relative misfit |g - H f|_i / (|g| + |H| |f|)_i of the measurements without noise.

        Rounding leaves 1e-16, float32 measurements 1e-7; contradictory measurements leave more. NaN counts as 1.
        """
        noise_free = self.problem.noise_variance == 0
        misfit = (self.recorded(recorded) - self.forward(u)).high[:, 0]
        size = np.abs(recorded) + self._magnitudes[0] @ np.abs(self.image(u).high[:, 0])
        relative = np.divide(np.abs(misfit), size, out=np.zeros_like(size), where=noise_free & (size != 0))
        return float(np.nan_to_num(relative, nan=1.0).max(initial=0.0))
