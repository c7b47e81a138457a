"""The marginal likelihood of misalignments: what a stack tells of how its camera was put together.

Measurements are, for misalignments t that the tolerance spreads,

    g - H(t) f0 ~ N(0, C),   C = H(t) P0 H(t)^T + Rv,   t ~ N(0, tolerance^2),

and the value is minus the logarithm of both together (Mardia and Marshall 1984), without constants. With
q = C^-1 (g - H f0), f^ = f0 + P0 H^T q the estimate, A its gain and P its covariance, a change dH of one sub-imager's
rows changes it by

    trace(A dH) - q^T dH f^,

and to second order, with x = dH f^ and y = dH^T q of a first number and x', y' of a second one, by

    x^T C^-1 x' + x^T A^T y' + y^T A x' - y^T P y' + trace(C^-1 dH P dH'^T) - trace(A dH A dH'),

where the first and the fifth term are what to expect of dH f, and the others vanish on average but for the last. The
estimate moves by df^ = P y - A x. All of it takes matrices of (N, N) and (N, M), none of (M, M).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ..prior import Prior

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
OfNumbers = Callable[[Matrix], sparse.csr_array]


@dataclass(frozen=True)
class MisalignedRecording:
    """Measurements that count, and what is known of them and of the image.

    recorded, noise_variance : (m,), noise above 0;  owner : (m,) the sub-imager of each
    matrix_of : H, (m, N), for a table of misalignments, (sub-imagers, 6);  tolerances : of that table
    """

    recorded: Vector
    noise_variance: Vector
    owner: NDArray[np.intp]
    prior: Prior
    matrix_of: OfNumbers
    tolerances: Matrix

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """(K, 2): sub-imager and parameter of all numbers that are to be found."""
        return np.argwhere(self.tolerances > 0)

    def table(self, scores: Vector) -> Matrix:
        """Misalignments, (sub-imagers, 6), of (K,) numbers in units of their tolerances."""
        table = np.zeros_like(self.tolerances)
        table[tuple(self.free.T)] = scores
        return table * self.tolerances


@dataclass(frozen=True)
class LikelihoodPoint:
    """All that is computed for one set of misalignments, `scores` in units of the tolerance: (K,)."""

    recording: MisalignedRecording
    scores: Vector
    matrix: sparse.csr_array
    inner: Matrix  # Cholesky factor of I + L^T H^T Rv^-1 H L
    value: float
    pull: Vector
    image: Vector

    @cached_property
    def covariance(self) -> Matrix:
        """P, (N, N)."""
        root = self.recording.prior.root
        wide = np.diag(root) if root.ndim == 1 else root
        half = np.asarray(linalg.solve_triangular(self.inner, wide.T, lower=True, check_finite=False))
        return half.T @ half

    @cached_property
    def gain(self) -> Matrix:
        """A = P H^T Rv^-1: (N, m)."""
        return np.ascontiguousarray((self.matrix @ self.covariance).T) / self.recording.noise_variance

    def changes(self, steps: Vector, one_sided: bool = False) -> ParameterDerivatives:
        """Derivatives of H as differences over +-`steps`, (K,), of the scores, or over `steps` alone."""
        recording, width = self.recording, np.zeros_like(self.recording.tolerances)
        width[tuple(recording.free.T)] = steps
        around, found = recording.table(self.scores), dict[int, sparse.csr_array]()
        for parameter in sorted(set(recording.free[:, 1].tolist())):
            step = np.zeros_like(width)
            step[:, parameter] = width[:, parameter] * recording.tolerances[:, parameter]
            ends = recording.matrix_of(around + step), self.matrix if one_sided else recording.matrix_of(around - step)
            per = np.divide(
                1.0 if one_sided else 0.5, width[:, parameter], out=np.zeros(len(width)), where=width[:, parameter] != 0
            )
            found[parameter] = sparse.csr_array((ends[0] - ends[1]).multiply(per[recording.owner][:, None]))
        return ParameterDerivatives(self, found)


@dataclass(frozen=True)
class ParameterDerivatives:
    """dH by one score of every sub-imager at once, for each parameter: (m, N), a row by that of its own sub-imager."""

    point: LikelihoodPoint
    by_parameter: dict[int, sparse.csr_array]

    @cached_property
    def gradient(self) -> Vector:
        """Of the value, by the scores: (K,)."""
        point = self.point
        table = np.zeros_like(point.recording.tolerances)
        for parameter, change in self.by_parameter.items():
            told = np.asarray(change.multiply(point.gain.T).sum(axis=1)).ravel()
            told -= point.pull * (change @ point.image)
            table[:, parameter] = self._sums(told)
        return table[tuple(point.recording.free.T)] + point.scores

    @cached_property
    def moved(self) -> tuple[Matrix, Matrix]:
        """x = dH f^, (m, K), and y = dH^T q, (N, K), by every score."""
        point, recording = self.point, self.point.recording
        x, y = np.zeros((recording.owner.size, len(recording.free))), np.zeros((point.image.size, len(recording.free)))
        for place, (sub, parameter) in enumerate(recording.free):
            rows = np.flatnonzero(recording.owner == sub)
            change = self.by_parameter[int(parameter)][rows]
            x[rows, place] = change @ point.image
            y[:, place] = change.T @ point.pull[rows]
        return x, y

    @cached_property
    def shifts(self) -> Matrix:
        """df^ = P y - A x by every score: (N, K)."""
        x, y = self.moved
        return self.point.covariance @ y - self.point.gain @ x

    def curvature(self, whole: bool = True) -> Matrix:
        """Second derivatives of the value by the scores, (K, K), without those of H itself.

        whole : whether traces over two different sub-imagers count, which are small and take most of the time
        """
        point, (x, y) = self.point, self.moved
        weighted, moved = x / point.recording.noise_variance[:, None], point.gain @ x
        # C^-1 = Rv^-1 - Rv^-1 H A
        by_image = x.T @ weighted - weighted.T @ (point.matrix @ moved)
        crossed = moved.T @ y
        return by_image + crossed + crossed.T - y.T @ (point.covariance @ y) + self._traces(whole) + np.eye(x.shape[1])

    def _traces(self, whole: bool) -> Matrix:
        """trace(C^-1 dH P dH'^T) - trace(A dH A dH') of every two scores: (K, K)."""
        point, recording = self.point, self.point.recording
        noise, size = recording.noise_variance, len(recording.tolerances)
        found = np.zeros((size, recording.tolerances.shape[1]) * 2)
        for sub in range(size):
            rows = np.flatnonzero(recording.owner == sub)
            others = np.flatnonzero(recording.owner >= sub) if whole else rows
            inverse = -(point.matrix[rows] @ point.gain[:, others]) / noise[rows][:, None]  # of C
            inverse[np.arange(rows.size), np.searchsorted(others, rows)] += 1 / noise[rows]
            for first, change in self.by_parameter.items():
                there = change[rows] @ point.covariance, change[rows] @ point.gain[:, others]
                for second, other in self.by_parameter.items():
                    back = other[others]
                    product = (back @ there[0].T).T * inverse - (back @ point.gain[:, rows]).T * there[1]
                    found[sub, first, :, second] = self._sums(product.sum(axis=0), others)
            found[sub, :, sub] *= 0.5
        free = tuple(recording.free.T)
        chosen = found[free][:, *free]
        return chosen + chosen.T

    def _sums(self, values: Vector, rows: NDArray[np.intp] | slice = slice(None)) -> Vector:
        recording = self.point.recording
        found = np.zeros(len(recording.tolerances))
        np.add.at(found, recording.owner[rows], values)
        return found


def point_at(recording: MisalignedRecording, scores: Vector) -> LikelihoodPoint:
    """The value, minus the logarithm of likelihood and tolerance, and what goes with it."""
    matrix, prior, noise = recording.matrix_of(recording.table(scores)), recording.prior, recording.noise_variance
    weighted = sparse.csr_array(matrix.multiply(1 / noise[:, None]))
    normal = sparse.csr_array(matrix.T @ weighted)
    if prior.independent:
        inner: Matrix = prior.root[:, None] * normal.toarray() * prior.root
    else:
        inner = prior.root.T @ (normal @ prior.root)
    inner[np.diag_indices_from(inner)] += 1.0
    factor = np.asarray(linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False))
    residual: Vector = recording.recorded - matrix @ prior.mean
    u: Vector = np.asarray(
        linalg.cho_solve((factor, True), prior.apply_root_transposed(weighted.T @ residual), check_finite=False)
    )
    pull: Vector = (residual - matrix @ prior.apply_root(u)) / noise
    squares = float(noise @ pull**2 + u @ u + scores @ scores)
    determinant = float(np.log(noise).sum() + 2 * np.log(np.diagonal(factor)).sum())
    image = prior.mean + prior.apply_root(u)
    return LikelihoodPoint(recording, scores, matrix, factor, 0.5 * (squares + determinant), pull, image)
