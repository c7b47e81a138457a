"""A and C of a frame of any H by conjugate gradients, to the few digits that means over a frame need.

They are those of the whole frame, which the estimate by overlapping tiles approaches to a few hundredths.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import fft, sparse
from scipy.sparse.linalg import LinearOperator, cg

from ommatid.runtime.arrays import FloatArray

from .method import EstimationTask, PosteriorOperators

RESIDUAL = 1e-3  # relative: the error of the solution is about 5 times as large
MAX_STEPS = 1000  # reached only where lens types leave pixels undetermined


def iterative_operators(task: EstimationTask) -> PosteriorOperators:
    """Return the operators of a task whose every measurement has noise."""
    matrix = task.model.matrix if task.complete else sparse.csr_array(task.model.matrix[task.used])
    weights, precision = 1 / task.expected_noise, task.precision_on(task.shape)
    count = task.model.unknowns

    def apply(image: FloatArray) -> FloatArray:
        product: FloatArray = matrix.T @ (weights * (matrix @ image))
        return product + _precision(image, precision, task.shape)

    diagonal = np.asarray(matrix.power(2).T @ weights) + float(np.mean(precision))
    system = LinearOperator((count, count), matvec=apply, dtype=np.float64)
    scaled = LinearOperator((count, count), matvec=lambda image: image / diagonal, dtype=np.float64)

    def posterior(image: FloatArray) -> FloatArray:
        solution: Any = cast(Any, cg)(system, image, rtol=RESIDUAL, maxiter=MAX_STEPS, M=scaled)[0]
        return np.asarray(solution, dtype=np.float64)

    return PosteriorOperators(
        gain=lambda values: posterior(matrix.T @ (weights * values)),
        posterior=posterior,
        weigh=lambda values: weights * values,
        hidden=lambda image: posterior(_precision(image, precision, task.shape)),
    )


def _precision(image: FloatArray, precision: float | FloatArray, shape: tuple[int, int]) -> FloatArray:
    if isinstance(precision, float):
        return precision * image
    waves = precision * np.asarray(fft.dctn(image.reshape(shape), 2, norm="ortho"))
    return np.asarray(fft.idctn(waves, 2, norm="ortho")).ravel()
