"""Products of a sparse matrix with its own transpose, dense where the matrix is.

A matrix with an entry in every tenth place or so, such as H of lenses that diffract, is multiplied a hundred times
faster as a dense one.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.memory import free_memory

DENSE = 0.1  # share of entries from which dense products are faster
SMALL = 10_000  # entries of a matrix for which it makes no difference


def gram(matrix: sparse.csr_array, weights: FloatArray | None = None) -> FloatArray:
    """Return A^T diag(w) A of a matrix A, (M, N), and (M,) weights, 1 where they are absent: (N, N)."""
    if is_dense(matrix):
        dense = matrix.toarray()
        return dense.T @ (dense if weights is None else weights[:, None] * dense)
    weighted = matrix if weights is None else sparse.csr_array(matrix.multiply(weights[:, None]))
    return np.asarray((matrix.T @ weighted).toarray())


def is_dense(matrix: sparse.csr_array) -> bool:
    """Return True if products of a matrix are faster, and fit into memory, with all its zeros stored."""
    rows, columns = matrix.shape
    return SMALL < matrix.nnz > DENSE * rows * columns and 2 * 8 * rows * columns < free_memory()
