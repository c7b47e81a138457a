"""Fit the misalignments of a camera to a stack that it recorded of an unknown image.

Sub-imagers see the same image, so their measurements determine their relative positions. The fit maximises the marginal
likelihood within the tolerance. The remaining uncertainty moves the estimate, and so adds to its error: by the law of
total variance, to P of Eq. 5 the covariance of f^ over the misalignments.

For misalignments t with the given tolerance, measurements are

    g - H(t) f0 ~ N(0, C),   C = H(t) P0 H(t)^T + Rv,   t ~ N(0, tolerance^2),

and the value is minus the logarithm of both together (Mardia and Marshall 1984), without constants. With
q = C^-1 (g - H f0), f^ = f0 + P0 H^T q the estimate, A its gain and P its covariance, a change dH of one sub-imager's
rows changes it by

    trace(A dH) - q^T dH f^,

and to second order, with x = dH f^ and y = dH^T q of a first parameter and x', y' of a second one, by

    x^T C^-1 x' + x^T A^T y' + y^T A x' - y^T P y' + trace(C^-1 dH P dH'^T) - trace(A dH A dH'),

where the first and the fifth term are the expectation over dH f; of the others only the last does not vanish on
average. The estimate changes by df^ = P y - A x. All matrices are (N, N) or (N, M), none is (M, M).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import Misalignment

from ..prior import Prior
from .robust_noise import as_misalignments, misaligned_matrix, tolerances

MAX_PIXELS = 4000  # of f: beyond, its dense matrices take too long
MAX_ITERATIONS = 40
INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-6, 1e6
CONVERGED = 0.1  # change of the value that ends the search; one standard deviation of one parameter is worth 0.5
MIN_STEP = 1e-5  # of a difference, in tolerances, so that it keeps its digits
NARROWING = 0.8  # factor by which steps may still shrink when the search ends
COOLING, COLD = 0.25, 0.1  # factor on the additional noise per iteration; share of Rv below which it is dropped
LEAPS = (-1.0, -0.3, -0.1, 0.1, 0.3, 1.0)  # tolerances, across a kink
MAX_LEAPS = 6  # tried with exact values


@dataclass(frozen=True)
class MisalignedRecording:
    """The measurements used, with their noise and the prior of the image.

    recorded, noise_variance : (m,), noise above 0;  owner : (m,) index of the sub-imager
    matrix_of : from a table of misalignments, (sub-imagers, 6), to H, (m, N);  tolerances : of that table
    """

    recorded: FloatArray
    noise_variance: FloatArray
    owner: NDArray[np.intp]
    prior: Prior
    matrix_of: Callable[[FloatArray], sparse.csr_array]
    tolerances: FloatArray

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Sub-imager and parameter of all numbers that are to be fitted: (K, 2)."""
        return np.argwhere(self.tolerances > 0)

    def table(self, scores: FloatArray) -> FloatArray:
        """Return misalignments, (sub-imagers, 6), from (K,) numbers in units of their tolerances."""
        table = np.zeros_like(self.tolerances)
        table[tuple(self.free.T)] = scores
        return table * self.tolerances


@dataclass(frozen=True)
class LikelihoodPoint:
    """The value at one set of misalignments, `scores`, (K,), in units of the tolerance, and what it was computed from.

    inner : Cholesky factor of I + L^T H^T Rv^-1 H L;  multipliers : q, (m,);  image : f^, (N,)
    """

    recording: MisalignedRecording
    scores: FloatArray
    matrix: sparse.csr_array
    inner: FloatArray
    value: float
    multipliers: FloatArray
    image: FloatArray

    @cached_property
    def covariance(self) -> FloatArray:
        """P, (N, N)."""
        root = self.recording.prior.root
        dense = np.diag(root) if root.ndim == 1 else root
        half = np.asarray(linalg.solve_triangular(self.inner, dense.T, lower=True, check_finite=False))
        return half.T @ half

    @cached_property
    def gain(self) -> FloatArray:
        """A = P H^T Rv^-1: (N, m)."""
        return np.ascontiguousarray((self.matrix @ self.covariance).T) / self.recording.noise_variance

    def derivatives(self, steps: FloatArray, one_sided: bool = False) -> ParameterDerivatives:
        """Return derivatives of H as differences over +-`steps`, (K,), of the scores, or over `steps` alone."""
        recording, width = self.recording, np.zeros_like(self.recording.tolerances)
        width[tuple(recording.free.T)] = steps
        around = recording.table(self.scores)
        by_parameter: dict[int, sparse.csr_array] = {}
        for parameter in sorted(set(recording.free[:, 1].tolist())):
            step = np.zeros_like(width)
            step[:, parameter] = width[:, parameter] * recording.tolerances[:, parameter]
            ends = recording.matrix_of(around + step), self.matrix if one_sided else recording.matrix_of(around - step)
            factor = np.divide(
                1.0 if one_sided else 0.5, width[:, parameter], out=np.zeros(len(width)), where=width[:, parameter] != 0
            )
            difference = (ends[0] - ends[1]).multiply(factor[recording.owner][:, None])
            by_parameter[parameter] = sparse.csr_array(difference)
        return ParameterDerivatives(self, by_parameter)


@dataclass(frozen=True)
class ParameterDerivatives:
    """Derivatives of H by each parameter, (m, N): every row by the score of its own sub-imager."""

    point: LikelihoodPoint
    by_parameter: dict[int, sparse.csr_array]

    @cached_property
    def gradient(self) -> FloatArray:
        """The gradient of the value with respect to the scores, (K,)."""
        point = self.point
        table = np.zeros_like(point.recording.tolerances)
        for parameter, change in self.by_parameter.items():
            by_row = np.asarray(change.multiply(point.gain.T).sum(axis=1)).ravel()
            by_row -= point.multipliers * (change @ point.image)
            table[:, parameter] = self._sums(by_row)
        return table[tuple(point.recording.free.T)] + point.scores

    @cached_property
    def changes(self) -> tuple[FloatArray, FloatArray]:
        """x = dH f^, (m, K), and y = dH^T q, (N, K), by every score."""
        point, recording = self.point, self.point.recording
        x, y = np.zeros((recording.owner.size, len(recording.free))), np.zeros((point.image.size, len(recording.free)))
        for index, (sub, parameter) in enumerate(recording.free):
            rows = np.flatnonzero(recording.owner == sub)
            change = self.by_parameter[int(parameter)][rows]
            x[rows, index] = change @ point.image
            y[:, index] = change.T @ point.multipliers[rows]
        return x, y

    @cached_property
    def shifts(self) -> FloatArray:
        """df^ = P y - A x by every score: (N, K)."""
        x, y = self.changes
        return self.point.covariance @ y - self.point.gain @ x

    def curvature(self, whole: bool = True) -> FloatArray:
        """Return second derivatives of the value by the scores, (K, K), without those of H itself.

        whole : True to include traces over two different sub-imagers, which are small and take most of the time
        """
        point, (x, y) = self.point, self.changes
        weighted, moved = x / point.recording.noise_variance[:, None], point.gain @ x
        # C^-1 = Rv^-1 - Rv^-1 H A
        by_image = x.T @ weighted - weighted.T @ (point.matrix @ moved)
        crossed = moved.T @ y
        return by_image + crossed + crossed.T - y.T @ (point.covariance @ y) + self._traces(whole) + np.eye(x.shape[1])

    def _traces(self, whole: bool) -> FloatArray:
        """Return trace(C^-1 dH P dH'^T) - trace(A dH A dH') for every two scores: (K, K)."""
        point, recording = self.point, self.point.recording
        noise, size = recording.noise_variance, len(recording.tolerances)
        traces = np.zeros((size, recording.tolerances.shape[1]) * 2)
        for sub in range(size):
            rows = np.flatnonzero(recording.owner == sub)
            others = np.flatnonzero(recording.owner >= sub) if whole else rows
            inverse = -(point.matrix[rows] @ point.gain[:, others]) / noise[rows][:, None]  # of C
            inverse[np.arange(rows.size), np.searchsorted(others, rows)] += 1 / noise[rows]
            for first, change in self.by_parameter.items():
                left = change[rows] @ point.covariance, change[rows] @ point.gain[:, others]
                for second, other in self.by_parameter.items():
                    right = other[others]
                    product = (right @ left[0].T).T * inverse - (right @ point.gain[:, rows]).T * left[1]
                    traces[sub, first, :, second] = self._sums(product.sum(axis=0), others)
            traces[sub, :, sub] *= 0.5
        free = tuple(recording.free.T)
        chosen = traces[free][:, *free]
        return chosen + chosen.T

    def _sums(self, values: FloatArray, rows: NDArray[np.intp] | slice = slice(None)) -> FloatArray:
        """Return sums over the measurements of each sub-imager."""
        recording = self.point.recording
        sums = np.zeros(len(recording.tolerances))
        np.add.at(sums, recording.owner[rows], values)
        return sums


def likelihood_at(recording: MisalignedRecording, scores: FloatArray) -> LikelihoodPoint:
    """Evaluate minus the logarithm of likelihood and tolerance at misalignments, (K,), in units of the tolerance."""
    matrix, prior, noise = recording.matrix_of(recording.table(scores)), recording.prior, recording.noise_variance
    weighted = sparse.csr_array(matrix.multiply(1 / noise[:, None]))
    normal = sparse.csr_array(matrix.T @ weighted)
    if prior.independent:
        inner: FloatArray = prior.root[:, None] * normal.toarray() * prior.root
    else:
        inner = prior.root.T @ (normal @ prior.root)
    inner[np.diag_indices_from(inner)] += 1.0
    factor = np.asarray(linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False))
    residual: FloatArray = recording.recorded - matrix @ prior.mean
    gathered = prior.apply_root_transposed(weighted.T @ residual)
    u: FloatArray = np.asarray(linalg.cho_solve((factor, True), gathered, check_finite=False))
    multipliers: FloatArray = (residual - matrix @ prior.apply_root(u)) / noise
    squares = float(noise @ multipliers**2 + u @ u + scores @ scores)
    determinant = float(np.log(noise).sum() + 2 * np.log(np.diagonal(factor)).sum())
    image = prior.mean + prior.apply_root(u)
    return LikelihoodPoint(recording, scores, matrix, factor, 0.5 * (squares + determinant), multipliers, image)


@dataclass(frozen=True)
class Alignment:
    """Fitted misalignments of the sub-imagers, in the order of measurements, and their uncertainty.

    misalignments, deviations : fitted, and their standard deviations from the curvature
    matrix : (M, N) H with these misalignments
    covariance : (K, K) of the fitted parameters;  numbers : (K, 2) their sub-imagers and columns of `as_table`
    shifts : (N, K) derivative of the estimate by each of them
    """

    misalignments: tuple[Misalignment, ...]
    deviations: tuple[Misalignment, ...]
    matrix: sparse.csr_array
    covariance: FloatArray
    numbers: NDArray[np.intp]
    shifts: FloatArray
    converged: bool

    @cached_property
    def variance(self) -> FloatArray:
        """Variance of every pixel due to the uncertainty of the misalignments: (N,), to first order."""
        return np.einsum("ik,kl,il->i", self.shifts, self.covariance, self.shifts)

    def variance_of_sum(self, weights: FloatArray) -> float:
        """Return the same of a weighted sum of pixels; weights : (N,)."""
        shift = self.shifts.T @ weights
        return float(shift @ self.covariance @ shift)


def align(
    camera: Camera, recorded: FloatArray, noise_variance: FloatArray, prior: Prior, used: BoolArray | None = None
) -> Alignment:
    """Fit the misalignments that are most likely given the camera's tolerance and the measurements.

    recorded, noise_variance : (m,) of the measurements used;  used : (M,) absent: all
    Raises InputError for a frame, for a camera without tolerance or with lenses of surfaces, and without noise.
    """
    recording = misaligned_recording(camera, recorded, noise_variance, prior, used)
    derivatives, converged = _search(recording)
    covariance = np.asarray(linalg.inv(_at_least_one(derivatives.curvature())))
    scale, table = recording.tolerances[tuple(recording.free.T)], recording.table(derivatives.point.scores)
    return Alignment(
        as_misalignments(table),
        as_misalignments(recording.table(np.sqrt(np.diagonal(covariance)))),
        misaligned_matrix(camera, table),
        covariance * np.outer(scale, scale),
        recording.free,
        derivatives.shifts / scale,
        converged,
    )


def misaligned_recording(
    camera: Camera, recorded: FloatArray, noise_variance: FloatArray, prior: Prior, used: BoolArray | None = None
) -> MisalignedRecording:
    """Return the data of the search; arguments and errors are those of `align`."""
    if camera.unknowns > MAX_PIXELS:
        raise InputError(
            f"estimator.misalignment: 'fit' serves up to {MAX_PIXELS} pixels of f, got {camera.rows} x"
            f" {camera.columns}; take 'robust', or fit a smaller crop of the target"
        )
    spread = tolerances(camera)
    if not spread.any():
        raise InputError("estimator.misalignment: 'fit' needs to know what may be misaligned; add a [camera.tolerance]")
    if not (noise_variance > 0).all():
        raise InputError(
            "estimator.misalignment: 'fit' needs noise in every measurement, got some without; set noise.variance or"
            " estimator.noise_variance to a number above 0"
        )
    chosen = np.ones(camera.measurements, dtype=np.bool_) if used is None else used
    owner = np.repeat(np.arange(len(spread)), [rows.stop - rows.start for rows in camera.slices()])[chosen]

    def matrix_of(table: FloatArray) -> sparse.csr_array:
        return misaligned_matrix(camera, table)[chosen]

    return MisalignedRecording(recorded, noise_variance, owner, prior, matrix_of, spread)


def _search(recording: MisalignedRecording) -> tuple[ParameterDerivatives, bool]:
    """Return the derivatives at the point of least value, and True if the search converged.

    The method is that of Levenberg and Marquardt. At first misalignment itself counts as noise, less and less of it as
    it becomes known, and derivatives are differences over what is still unknown: otherwise parameters settle on the
    wrong side of a kink of H.
    """
    point = likelihood_at(recording, np.zeros(len(recording.free)))
    steps, damping = np.ones(point.scores.size), INITIAL_DAMPING
    extra = _variance_of_misalignment(point.derivatives(steps))
    for _ in range(MAX_ITERATIONS):
        extra *= COOLING if extra > COLD * float(recording.noise_variance.min()) else 0.0
        point = likelihood_at(replace(recording, noise_variance=recording.noise_variance + extra), point.scores)
        derivatives = point.derivatives(steps)
        curvature = _at_least_one(derivatives.curvature(whole=False))
        better, damping = _step(point, derivatives.gradient, curvature, damping)
        narrower = np.clip(np.sqrt(np.diagonal(linalg.inv(curvature))), MIN_STEP, 1.0)
        settled = extra == 0 and bool(np.all(narrower > NARROWING * steps)) and point.value - better.value < CONVERGED
        point, steps = better, narrower
        if settled:
            leapt = _leap(point)
            if leapt is None:
                return point.derivatives(steps), True
            point = leapt
    return likelihood_at(recording, point.scores).derivatives(steps), False


def _leap(point: LikelihoodPoint) -> LikelihoodPoint | None:
    """Return a better point that one parameter alone reaches across a kink, or None.

    Of all leaps, those that the derivatives rank best are evaluated.
    """
    recording, size = point.recording, point.scores.size
    leaps: list[tuple[float, int, float]] = []
    for leap in LEAPS:
        derivatives = point.derivatives(np.full(size, leap), one_sided=True)
        expected = leap * derivatives.gradient + 0.5 * leap**2 * np.diagonal(derivatives.curvature(whole=False))
        leaps += [(float(expected[index]), index, leap) for index in range(size)]
    for _, index, leap in sorted(leaps)[:MAX_LEAPS]:
        scores = point.scores.copy()
        scores[index] += leap
        other = likelihood_at(recording, scores)
        if other.value < point.value:
            return other
    return None


def _variance_of_misalignment(derivatives: ParameterDerivatives) -> float:
    """Return the mean variance of a measurement due to misalignment within the tolerance."""
    variance = derivatives.point.recording.prior.variance
    squares = [float((change.power(2) @ variance).mean()) for change in derivatives.by_parameter.values()]
    return sum(squares)


def _step(
    point: LikelihoodPoint, gradient: FloatArray, curvature: FloatArray, damping: float
) -> tuple[LikelihoodPoint, float]:
    """Return a better point, or the same where there is none, and the damping to start with next time."""
    while damping < MAX_DAMPING:
        damped = curvature + damping * np.diag(np.diagonal(curvature))
        scores = point.scores - linalg.solve(damped, gradient, assume_a="pos")
        better = likelihood_at(point.recording, scores)
        if better.value < point.value:
            return better, max(damping / 10, MIN_DAMPING)
        damping *= 10
    return point, INITIAL_DAMPING


def _at_least_one(curvature: FloatArray) -> FloatArray:
    """Return the curvature with eigenvalues raised to 1, the tolerance's own."""
    values, vectors = linalg.eigh(0.5 * (curvature + curvature.T))
    return (vectors * np.maximum(values, 1.0)) @ vectors.T
