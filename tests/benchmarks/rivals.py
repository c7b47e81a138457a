"""Other ways to estimate a whole frame, all from the same H and g. Each is a function of `RIVALS`, and no more.

Whatever a way makes of H, which is given as a sparse matrix, counts as its time and its memory: whitening it, the
normal matrix K = H^T Rv^-1 H + P0^-1, factors.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import lsmr

from .whole import MEAN, NOISE, VARIANCE, Whole, whole_scene

Vector = NDArray[np.float64]
Watch = Callable[[Vector], None] | None


@dataclass(frozen=True)
class Rival:
    """How it is called, its function of (frame, H, most steps, who sees every step), and what to hope for.

    steps : 'cg' or 'lsmr', whose count it needs, or none if it is direct
    """

    name: str
    solve: Callable[[Whole, sparse.csr_array, int, Watch], Vector]
    steps: str = ""
    aim: float | None = None
    memory_aim: float | None = None
    stored: bool = True


def normal_matrix(matrix: sparse.csr_array) -> sparse.csr_array:
    """K, (N, N)."""
    return sparse.csr_array(matrix.T @ matrix / NOISE + sparse.eye_array(matrix.shape[1], format="csr") / VARIANCE)


def by_lsmr(whole: Whole, matrix: sparse.csr_array, steps: int, watch: Watch = None) -> Vector:
    """SciPy's LSMR on [Rv^-1/2 H; P0^-1/2] x = [Rv^-1/2 (g - H f0); 0]."""
    del watch  # it shows nobody its steps
    below = sparse.eye_array(matrix.shape[1], format="csr") * VARIANCE**-0.5
    whitened = sparse.vstack([matrix * NOISE**-0.5, below], format="csr")
    right = np.concatenate([whole.unexpected * NOISE**-0.5, np.zeros(matrix.shape[1])])
    return lsmr(whitened, right, atol=0, btol=0, conlim=0, maxiter=steps)[0]


def by_cg(whole: Whole, matrix: sparse.csr_array, steps: int, watch: Watch = None) -> Vector:
    """PyLops' conjugate gradients on K, stored; its cgls on H, damped, takes as many steps and three times as long."""
    from pylops import MatrixMult
    from pylops.optimization.basic import cg

    operator = MatrixMult(normal_matrix(matrix), dtype="float64")  # pyright: ignore[reportArgumentType]
    right = matrix.T @ whole.unexpected / NOISE
    return cg(operator, right, np.zeros(right.size), niter=steps, tol=0, callback=watch)[0]


def by_boxes(whole: Whole, matrix: sparse.csr_array, steps: int, watch: Watch = None) -> Vector:
    """PyLops' conjugate gradients on our K, of which nothing is stored: what is left of ours is its preconditioner."""
    from pylops import FunctionOperator
    from pylops.optimization.basic import cg

    del matrix
    frame = whole.frame()
    right = frame.right_hand_side(whole.unexpected)
    return cg(
        FunctionOperator(frame.apply, right.size), right, np.zeros(right.size), niter=steps, tol=0, callback=watch
    )[0]


def by_cholesky(whole: Whole, matrix: sparse.csr_array, steps: int = 0, watch: Watch = None) -> Vector:
    """CHOLMOD's supernodal factorisation of K, in the order of its own choice (AMD), as cvxopt brings it."""
    del steps, watch
    return factorised(matrix)(matrix.T @ whole.unexpected / NOISE)


def factorised(matrix: sparse.csr_array) -> Callable[[Vector], Vector]:
    """K^-1 by a Cholesky factorisation that is kept."""
    import cvxopt
    from cvxopt import cholmod  # pyright: ignore[reportAttributeAccessIssue], compiled

    lower = sparse.tril(normal_matrix(matrix), format="coo")
    rows, columns = (index.astype(np.int64) for index in (lower.row, lower.col))
    precision = cvxopt.spmatrix(lower.data, rows, columns, lower.shape)
    del lower, rows, columns
    factor = cholmod.symbolic(precision)
    cholmod.numeric(precision, factor)

    def solve(right: Vector) -> Vector:
        solution = cvxopt.matrix(right)
        cholmod.solve(factor, solution)
        return np.array(solution).ravel()

    return solve


def by_tiles(whole: Whole, matrix: sparse.csr_array, steps: int = 0, watch: Watch = None) -> Vector:
    """Our own dense tiles of 35 less a border of 8, which share their factorisations; not as right as the others."""
    from ommatid.reconstruct.methods.method import EstimationTask, Execution
    from ommatid.reconstruct.methods.tile_method import TileMethod
    from ommatid.simulate.ideal import ideal_model

    del matrix, steps, watch
    scene = whole_scene(whole.camera.rows)
    every = (whole.camera.measurements,)
    believed, used = np.broadcast_to(NOISE, every), np.ones(every, dtype=np.bool_)
    model = ideal_model(scene, whole.camera)
    task = EstimationTask(model, whole.readings, used, believed, scene.prior, scene.estimator, scene.tiles)
    return TileMethod(task, Execution()).image - MEAN


RIVALS = (
    Rival("SciPy lsmr, whitened H over P0^-1/2", by_lsmr, "lsmr", aim=20.0),
    Rival("PyLops cg, K stored", by_cg, "cg"),
    Rival("PyLops cg, our K, nothing stored", by_boxes, "cg", stored=False),
    Rival("CHOLMOD (cvxopt), factor of K", by_cholesky, aim=8.0, memory_aim=5.0),
    Rival("our tiles of 35 less 8", by_tiles, stored=False),
)
