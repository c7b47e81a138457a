"""Solvers for a whole frame, from the same H and g; each is one function.

H is given as a sparse matrix, or as an operator where that is too large. Everything that a solver computes from it
counts as its time and memory: the normal matrix K = H^T Rv^-1 H + P0^-1, factors.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, lsmr

from ommatid.runtime.arrays import FloatArray

from .whole import MEAN, NOISE, VARIANCE, Whole

Matrix = sparse.csr_array | LinearOperator
Watch = Callable[[FloatArray], None] | None


@dataclass(frozen=True)
class Rival:
    """Name of a solver, and its function of (frame, H, largest number of steps, callback of every step).

    steps : "cg" or "lsmr", whose number of steps it takes, empty for a solver that needs no number
    stored : it needs H as a matrix or an operator;  wide : it serves kernels too wide to be stored
    """

    name: str
    solve: Callable[[Whole, Matrix, int, Watch], FloatArray]
    steps: str = ""
    stored: bool = True
    wide: bool = True


def by_frame(whole: Whole, matrix: Matrix, steps: int = 0, watch: Watch = None) -> FloatArray:
    """Solve with ommatid's frame solver, setup included."""
    del matrix, steps, watch
    return whole.estimate().image


def normal_matrix(matrix: Matrix) -> sparse.csr_array:
    """Return K, (N, N), of an H that is stored."""
    if isinstance(matrix, LinearOperator):
        raise TypeError("expected a stored H")
    return sparse.csr_array(matrix.T @ matrix / NOISE + sparse.eye_array(matrix.shape[1], format="csr") / VARIANCE)


def by_lsmr(whole: Whole, matrix: Matrix, steps: int, watch: Watch = None) -> FloatArray:
    """Solve with SciPy's LSMR on [Rv^-1/2 H; P0^-1/2] x = [Rv^-1/2 (g - H f0); 0]."""
    del watch  # LSMR has no callback
    count, unknowns = matrix.shape
    by_noise, by_prior = NOISE**-0.5, VARIANCE**-0.5
    transposed = matrix.T
    whitened = LinearOperator(
        (count + unknowns, unknowns),
        lambda image: np.concatenate([by_noise * (matrix @ image), by_prior * image]),
        lambda values: by_noise * (transposed @ values[:count]) + by_prior * values[count:],
        dtype=np.float64,
    )
    right = np.concatenate([whole.residual * by_noise, np.zeros(unknowns)])
    return lsmr(whitened, right, atol=0, btol=0, conlim=0, maxiter=steps)[0]


def by_cg(whole: Whole, matrix: Matrix, steps: int, watch: Watch = None) -> FloatArray:
    """Solve with PyLops' conjugate gradients on K, stored where H is.

    Its damped cgls on H takes as many steps and three times as long.
    """
    from pylops import FunctionOperator, MatrixMult
    from pylops.optimization.basic import cg

    if isinstance(matrix, LinearOperator):
        observation = whole.model.applied

        def applied(image: FloatArray) -> FloatArray:
            return observation.adjoint(observation.forward(image)) / NOISE + image / VARIANCE

        operator = FunctionOperator(applied, applied, matrix.shape[1], dtype="float64")
    else:
        operator = MatrixMult(normal_matrix(matrix), dtype="float64")  # pyright: ignore[reportArgumentType]
    right = matrix.T @ whole.residual / NOISE
    return cg(operator, right, np.zeros(right.size), niter=steps, tol=0, callback=watch)[0]


def by_cholesky(whole: Whole, matrix: Matrix, steps: int = 0, watch: Watch = None) -> FloatArray:
    """Solve with CHOLMOD's supernodal factorisation of K in AMD order, from cvxopt."""
    import cvxopt
    from cvxopt import cholmod  # pyright: ignore[reportAttributeAccessIssue], compiled

    del steps, watch
    lower = sparse.tril(normal_matrix(matrix), format="coo")
    rows, columns = (index.astype(np.int64) for index in (lower.row, lower.col))
    precision = cvxopt.spmatrix(lower.data, rows, columns, lower.shape)
    del lower, rows, columns
    factor = cholmod.symbolic(precision)
    cholmod.numeric(precision, factor)
    solution = cvxopt.matrix(matrix.T @ whole.residual / NOISE)
    cholmod.solve(factor, solution)
    return np.array(solution).ravel()


def by_tiles(whole: Whole, matrix: Matrix, steps: int = 0, watch: Watch = None) -> FloatArray:
    """Solve with dense tiles of 35 pixels and a border of 8, which share factorisations; less accurate."""
    from ommatid.reconstruct.methods.method import EstimationTask, Execution
    from ommatid.reconstruct.methods.tile_method import TileMethod

    del matrix, steps, watch
    model, scene = whole.model, whole.scene
    shape = (model.measurements,)
    noise, used = np.broadcast_to(NOISE, shape), np.ones(shape, dtype=np.bool_)
    task = EstimationTask(model, whole.readings, used, noise, scene.prior, scene.estimator, scene.tiles)
    return TileMethod(task, Execution()).image - MEAN


OURS = Rival("frame, unprepared", by_frame, stored=False)
RIVALS = (
    OURS,
    Rival("SciPy lsmr, whitened H over P0^-1/2", by_lsmr, "lsmr"),
    Rival("PyLops cg on K", by_cg, "cg"),
    Rival("CHOLMOD (cvxopt), factor of K", by_cholesky, wide=False),
    Rival("tiles of 35 less 8", by_tiles, stored=False, wide=False),
)
