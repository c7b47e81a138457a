"""Errors of blocks of measurements predicted from all other measurements, in closed form.

With g = H f + v, S = H P0 H^T + Rv and r = S^-1 (g - H f0), the best linear prediction of a block B from the
measurements outside B errs by

    e_B = W^-1 r_B  with covariance  W^-1,    W = [S^-1]_BB

(the leave-one-out identity of Gaussian processes, Rasmussen and Williams 2006, Eq. 5.12, for blocks). With a factor
S^-1 = F F^T and white residuals y = F^T (g - H f0), the errors z = Q^T y, where L Q^T = F_B is the factorisation of the
rows of F, are N(0, I) over draws of prior and noise, and e_B = L^-T z. One factorisation of S serves all blocks.

Rows are divided by the noise's standard deviation first, S~ = I + B B^T with B = Rv^-1/2 H L. Then F is either the
inverse root of S~ by orthogonal triangularisation, which squares nothing, or W = I - T T^T with T = B (I + B^T B)^-1/2,
which is cheap where unknowns are few, and loses digits where a block alone sees a component of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError

from ..forms.cholesky import information
from ..problem import NotSolvableError, Problem

EPS = float(np.finfo(np.float64).eps)
MOST_EXACT = 1000  # measurements up to which S itself is factorised, which keeps ten digits or more
MOST_ROOT = 6000  # measurements up to which that is possible
PRECISION = 1e-6  # of whitened errors by W = I - T T^T, by a cautious estimate; else S itself is factorised
LEAST_PRECISION = 1e-3  # where that is not possible
SAFETY = 30.0  # factor on the relative error of T T^T
PANEL = 32  # columns factorised together by LAPACK


@dataclass(frozen=True)
class BlockErrors:
    """What a prediction from all other measurements errs by, on the rows of one block.

    whitened : (b,) z;  error : (b,) e_B in the units of the measurements;  precision : (b,) diagonal of W
    """

    whitened: FloatArray
    error: FloatArray
    precision: FloatArray


class _ImpreciseError(Exception):
    """The factorisation keeps fewer digits than were asked for."""


def block_errors(problem: Problem, recorded: FloatArray, blocks: Sequence[IntArray]) -> list[BlockErrors]:
    """Predict every block from all measurements outside it.

    recorded : (M,) g;  blocks : indices of measurements, (b,) each
    Raises InputError if a measurement has no noise, or if the noise is too small for double precision.
    """
    if not problem.noisy:
        raise InputError(
            "a prediction of measurements without noise has nothing to be compared with; set noise.variance or"
            " estimator.noise_variance to a number above 0"
        )
    white = (recorded - problem.matrix @ problem.prior.mean) / problem.deviation
    large = problem.measurements > MOST_ROOT
    if large or problem.measurements > max(problem.prior.dimension, MOST_EXACT):
        try:
            return _by_unknowns(problem, white, blocks, LEAST_PRECISION if large else PRECISION)
        except (_ImpreciseError, NotSolvableError) as error:
            if large:
                raise InputError(
                    "the noise is too small beside the prior to predict sub-imagers in double precision; raise"
                    " estimator.noise_variance, or crop the target"
                ) from error
    return _by_measurements(problem, white, blocks)


def _by_unknowns(
    problem: Problem, white: FloatArray, blocks: Sequence[IntArray], precision: float
) -> list[BlockErrors]:
    """Use W = I - T T^T. Raises _ImpreciseError where the difference keeps less than `precision`."""
    form = information(problem)
    inverse, _ = linalg.lapack.dtrtri(form.factor.root, lower=1)
    root = np.tril(inverse) / form.factor.scale
    del inverse
    by_pixels = problem.prior.apply_root(np.ascontiguousarray(root.T))  # L (I + B^T B)^-1/2: (N, K)
    scaled = sparse.csr_array(problem.matrix.multiply(1 / problem.deviation[:, None]))

    def without_explained(values: FloatArray) -> FloatArray:
        return values - scaled @ (by_pixels @ (by_pixels.T @ (scaled.T @ values)))

    residual = without_explained(white)
    # One step of refinement shows the error of the solution, and so of T T^T.
    explained = scaled @ problem.prior.apply_root(problem.prior.apply_root_transposed(scaled.T @ residual))
    correction = float(np.abs(without_explained(white - residual - explained)).max(initial=0.0))
    relative = max(correction / float(np.abs(white - residual).max(initial=1.0)), EPS)
    if not correction <= precision:
        raise _ImpreciseError
    result: list[BlockErrors] = []
    for block in blocks:
        rows: FloatArray = scaled[block] @ by_pixels
        inner = -(rows @ rows.T)
        inner[np.diag_indices_from(inner)] += 1.0
        try:
            lower = np.asarray(linalg.cholesky(inner, lower=True, check_finite=False))
        except linalg.LinAlgError as error:
            raise _ImpreciseError from error
        if SAFETY * relative > precision * float(np.diagonal(lower).min(initial=1.0)) ** 2:
            raise _ImpreciseError
        whitened = np.asarray(linalg.solve_triangular(lower, residual[block], lower=True, check_finite=False))
        result.append(_block(lower, whitened, problem.deviation[block]))
    return result


def _by_measurements(problem: Problem, white: FloatArray, blocks: Sequence[IntArray]) -> list[BlockErrors]:
    """Use F = C^-1 of C^T C = I + B B^T."""
    inverse, _ = linalg.lapack.dtrtri(_upper_root(problem))
    upper = np.triu(inverse)
    y = upper.T @ white
    qr: Any = linalg.qr
    result: list[BlockErrors] = []
    for block in blocks:
        orthogonal, triangle = qr(upper[block].T, mode="economic", check_finite=False)
        result.append(_block(np.asarray(triangle).T, orthogonal.T @ y, problem.deviation[block]))
    return result


def _upper_root(problem: Problem) -> FloatArray:
    """Return the upper C of C^T C = I + B B^T, by QR of [I; B^T], which squares nothing."""
    dense = problem.dense_matrix()
    dense /= problem.deviation[:, None]
    panel = min(PANEL, problem.measurements)
    triangle, *_ = linalg.lapack.dtpqrt(0, panel, np.eye(problem.measurements, order="F"), np.asfortranarray(dense.T))
    return np.triu(triangle)


def _block(lower: FloatArray, z: FloatArray, deviation: FloatArray) -> BlockErrors:
    """Return the errors for W~ = L L^T in units of the noise."""
    solve: Any = linalg.solve_triangular
    error = deviation * np.asarray(solve(lower, z, lower=True, trans="T", check_finite=False))
    return BlockErrors(z, error, np.square(lower).sum(axis=1) / np.square(deviation))
