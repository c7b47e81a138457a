"""Eq. 4 and 5 by two other factorisations than the solver's, as a second opinion on it.

Both yield the estimate f^, (N,), and the posterior variances, (N,), of problems with noise in every measurement.
"""

from __future__ import annotations

import numpy as np

from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray

Posterior = tuple[FloatArray, FloatArray]


def by_singular_values(problem: Problem, recorded: FloatArray) -> Posterior:
    """Decompose B = S^-1 H L = U diag(s) V^T: u = V s / (1 + s^2) U^T S^-1 r; values below rounding count as 0."""
    prior, deviation = problem.prior, problem.deviation
    left, values, right = np.linalg.svd(problem.dense_matrix() / deviation[:, None])
    least = 4 * np.finfo(np.float64).eps * max(left.shape[0], right.shape[0]) * values.max(initial=0.0)
    values = np.where(values > least, values, 0.0)
    count = values.size
    seen = left.T[:count] @ ((recorded - problem.matrix @ prior.mean) / deviation)
    u = right[:count].T @ (values / (1 + values**2) * seen)
    squares = np.zeros(prior.dimension)
    squares[:count] = values**2
    modes = prior.apply_root(right.T)
    return prior.mean + prior.apply_root(u), np.square(modes) @ (1 / (1 + squares))


def by_array(problem: Problem, recorded: FloatArray) -> Posterior:
    """Triangularise [[S, 0], [(H L)^T, I]] (Kailath, Sayed and Hassibi 2000, section 12.3): C and K above, T below.

    u = K^T C^-T r, and T^T T is the posterior covariance of u. It inverts neither P0 nor Rv.
    """
    prior, dense = problem.prior, problem.dense_matrix()
    count = problem.measurements
    above = np.hstack([np.diag(problem.deviation), np.zeros((count, prior.dimension))])
    array = np.vstack([above, np.hstack([dense.T, np.eye(prior.dimension)])])
    triangle = np.asarray(np.linalg.qr(array, mode="r"), dtype=np.float64)
    white = np.linalg.solve(triangle[:count, :count].T, recorded - problem.matrix @ prior.mean)
    u = triangle[:count, count:].T @ white
    roots = prior.apply_root(triangle[count:, count:].T)
    return prior.mean + prior.apply_root(u), np.square(roots).sum(axis=1)
