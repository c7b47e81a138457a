"""The minimum-variance estimate and its expected error (Wood et al., Eq. 4 and Eq. 5), with dense matrices.

With g = H f + v, prior mean f0 and covariance P0, and noise covariance Rv,

    f^ = f0 + A (g - H f0),   A = P0 H^T (H P0 H^T + Rv)^-1                       (Eq. 4)
       = (H^T Rv^-1 H + P0^-1)^-1 H^T Rv^-1                                       (the same, information form)
    error covariance = (I - A H) P0M (I - A H)^T + A Rvm A^T                      (Eq. 5)

where P0M and Rvm are what prior and noise really are. The smaller of the two matrices is factorised: M x M in
measurement form, N x N in information form. P0 and Rv are diagonal and given as vectors. Eq. 5 is summed from squares,
so that no variance can come out negative.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from scenes.errors import InputError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Method = Literal["auto", "measurement", "information"]

CHUNK = 512


@dataclass(frozen=True)
class Gain:
    """A of Eq. 4, factorised. `factor` is the Cholesky factor of the matrix that `method` names."""

    method: Literal["measurement", "information"]
    matrix: sparse.csr_array
    prior_variance: Vector
    noise_variance: Vector
    factor: Matrix
    condition: float

    def apply(self, residual: Vector) -> Vector:
        """A r: (M,) to (N,), or (M, k) to (N, k) for many at once."""
        column = (slice(None), *[None] * (residual.ndim - 1))
        if self.method == "information":
            return _solve(self.factor, self.matrix.T @ (residual / self.noise_variance[column]))
        return self.prior_variance[column] * (self.matrix.T @ _solve(self.factor, residual))

    @cached_property
    def inverse(self) -> Matrix:
        """Inverse of the factorised matrix; in information form the posterior covariance, all of which Eq. 5 needs."""
        inverse, _ = linalg.lapack.dpotri(self.factor, lower=1)
        return np.tril(inverse) + np.tril(inverse, -1).T

    def rows_of_transpose(self) -> Iterator[tuple[slice, Matrix]]:
        """A^T, a few hundred measurements at a time: the whole of A would not fit where its pieces do."""
        inverse = self.inverse
        measurements = self.matrix.shape[0]
        for start in range(0, measurements, CHUNK):
            some = slice(start, min(start + CHUNK, measurements))
            if self.method == "information":
                yield some, (self.matrix[some] @ inverse) / self.noise_variance[some, None]
            else:
                yield some, np.asarray((self.matrix.T @ inverse[:, some]).T) * self.prior_variance

    def resolution_defect(self) -> Matrix:
        """I - A H: (N, N), what the estimate does not take from the image itself."""
        if self.method == "information":
            return self.inverse / self.prior_variance
        gain = self.prior_variance[:, None] * (self.matrix.T @ self.inverse)
        return np.eye(self.matrix.shape[1]) - (self.matrix.T @ gain.T).T


@dataclass(frozen=True)
class ExpectedError:
    """Eq. 5: (N,) `variance` of every pixel, and the parts of its mean that the prior and each noise bring.

    `missing` is the prior's part, "null space": what no measurement tells, or what the noise forbids to believe.
    """

    variance: Vector
    missing: float
    parts: dict[str, float]

    @property
    def mse(self) -> float:
        """Expected squared error, averaged over the pixels."""
        return float(self.variance.mean())


def factorise(
    matrix: sparse.csr_array, prior_variance: Vector, noise_variance: Vector, method: Method = "auto"
) -> Gain:
    """Factorise Eq. 4 in the form asked for, or in the smaller one.

    matrix : (M, N) H;  prior_variance : (N,) above 0;  noise_variance : (M,) above 0
    Raises InputError if memory does not suffice or if the matrix is not positive definite in float64.
    """
    measurements, unknowns = matrix.shape
    chosen = _chosen(measurements, unknowns, method)
    size = measurements if chosen == "measurement" else unknowns
    refuse_too_large(measurements, unknowns, method)
    if noise_variance.min() <= 0:
        raise InputError("the estimator needs an expected noise variance above 0; set estimator.noise_variance")
    if chosen == "information":
        scaled = sparse.csr_array(matrix.multiply(1 / noise_variance[:, None]))
        normal = (matrix.T @ scaled).toarray()
        normal[np.diag_indices(size)] += 1 / prior_variance
    else:
        normal = (matrix @ sparse.csr_array(matrix.multiply(prior_variance[None, :])).T).toarray()
        normal[np.diag_indices(size)] += noise_variance
    size_1 = float(np.abs(normal).sum(axis=0).max())
    try:
        factor = linalg.cholesky(normal, lower=True, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError as error:
        raise InputError(
            f"the {chosen} form of the estimator is not positive definite in double precision: the noise variance"
            f" {noise_variance.min():.3g} is too small beside the prior's {prior_variance.max():.3g};"
            " raise estimator.noise_variance"
        ) from error
    reciprocal, _ = linalg.lapack.dpocon(factor, size_1, uplo="L")
    condition = float(1 / reciprocal) if reciprocal > 0 else float("inf")
    return Gain(chosen, matrix, prior_variance, noise_variance, factor, condition)


def estimate(gain: Gain, measurements: Vector, mean: Vector) -> Vector:
    """Reconstruct the image with the least mean squared error of any linear estimator (Eq. 4): (M,) to (N,)."""
    return mean + gain.apply(measurements - gain.matrix @ mean)


def expected_error(gain: Gain, prior_variance: Vector, noise: dict[str, Vector]) -> ExpectedError:
    """Eq. 5 with the prior and the noises as they really are, whatever the estimator was told to expect.

    prior_variance : (N,), the diagonal of P0M;  noise : named (M,) variances that together are Rvm
    """
    defect = gain.resolution_defect()
    variance = np.square(defect, out=defect) @ prior_variance
    missing = float(variance.mean())
    weights = np.zeros(gain.matrix.shape[0])
    total = np.sum(list(noise.values()), axis=0) if noise else weights
    for some, transposed in gain.rows_of_transpose():
        squared = np.square(transposed, out=transposed)
        variance += total[some] @ squared
        weights[some] = squared.mean(axis=1)
    parts = {name: float(weights @ values) for name, values in noise.items()}
    return ExpectedError(variance, missing, parts)


def noise_covariance(gain: Gain, noise_variance: Vector) -> Matrix:
    """A Rvm A^T: (N, N), the covariance that noise of variances (M,) gives the estimate."""
    if gain.method == "information":
        weights = noise_variance / gain.noise_variance**2
        middle = gain.matrix.T @ sparse.csr_array(gain.matrix.multiply(weights[:, None]))
        return gain.inverse @ (middle @ gain.inverse)
    total = np.zeros((gain.matrix.shape[1],) * 2)
    for some, transposed in gain.rows_of_transpose():
        weighted = np.sqrt(noise_variance[some, None]) * transposed
        total += weighted.T @ weighted
    return total


def _solve(factor: Matrix, right: Vector) -> Vector:
    return np.asarray(linalg.cho_solve((factor, True), right, check_finite=False))


def _chosen(measurements: int, unknowns: int, method: Method) -> Literal["measurement", "information"]:
    if method == "auto":
        return "measurement" if measurements < unknowns else "information"
    return method


def refuse_too_large(measurements: int, unknowns: int, method: Method) -> None:
    """Raise InputError if the estimator's dense matrices would not fit in memory."""
    size = measurements if _chosen(measurements, unknowns, method) == "measurement" else unknowns
    needed = 8 * (3 * size**2 + 2 * unknowns**2)
    free = _free_memory()
    if needed > free:
        raise InputError(
            f"the dense estimator needs {needed / 1e9:.1f} GB for {unknowns} pixels, {free / 1e9:.1f} GB are free;"
            " crop the target with target.origin and target.shape"
        )


def _free_memory() -> int:
    """Bytes that can be had without swapping; where the system does not say, what is built in."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
