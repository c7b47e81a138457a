"""Windows of f and the rows of a stored H that see nothing outside them."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import IntArray

EMPTY = -1  # first and last pixel seen by a measurement that sees none: outside every window
Extents = tuple[IntArray, IntArray, IntArray, IntArray]


def extents(matrix: sparse.csr_array, columns: int) -> Extents:
    """Return the first and last row, first and last column of f that each row of H sees, (M,) each; EMPTY if none."""
    row, column = np.divmod(matrix.indices.astype(np.int64), columns)
    nonempty = np.diff(matrix.indptr) > 0
    starts = matrix.indptr[:-1][nonempty]
    found = [np.full(nonempty.size, EMPTY) for _ in range(4)]
    for extent, (values, extreme) in zip(found, product((row, column), (np.minimum, np.maximum)), strict=True):
        extent[nonempty] = extreme.reduceat(values, starts)
    top, bottom, left, right = found
    return top, bottom, left, right


def inside(seen: Extents, rows: slice, columns: slice) -> IntArray:
    """Return the indices of the rows of H that see nothing outside a window of f: (m,)."""
    top, bottom, left, right = seen
    return np.flatnonzero((top >= rows.start) & (bottom < rows.stop) & (left >= columns.start) & (right < columns.stop))


def on_window(matrix: sparse.csr_array, width: int, rows: slice, columns: slice) -> sparse.csr_array:
    """Return rows of H that see nothing outside a window, (m, N), on the window: (m, pixels of the window).

    width : columns of f
    """
    row, column = np.divmod(matrix.indices, width)
    shape = rows.stop - rows.start, columns.stop - columns.start
    indices = (row - rows.start) * shape[1] + column - columns.start
    return sparse.csr_array((matrix.data, indices, matrix.indptr), shape=(matrix.shape[0], shape[0] * shape[1]))
