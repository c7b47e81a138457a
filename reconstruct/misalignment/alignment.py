"""How a camera was put together, found from the stack that it recorded, whatever it looked at.

Sub-imagers see the same image, so they tell of one another where they stand. Found are the misalignments of largest
marginal likelihood, given their tolerance (`alignment_likelihood`). What is left unknown of them moves the estimate,
and so adds to its error: by the law of total variance, P of Eq. 5 and the covariance of f^ over them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.pose import Misalignment

from ..prior import Prior
from .likelihood import LikelihoodPoint, MisalignedRecording, ParameterDerivatives, point_at
from .robust_noise import as_misalignments, misaligned_matrix, tolerances

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

MOST = 4000  # pixels of f: beyond, its dense matrices take too long
ITERATIONS = 40
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e6
ENOUGH = 0.1  # change of the logarithm that ends the search: one standard deviation of one number is worth 0.5
LEAST_STEP = 1e-5  # of a difference, in tolerances, so that it keeps its digits
CLOSE = 0.8  # how far steps may still narrow when the search ends
COOLING, COLD = 0.25, 0.1  # of the noise that stands for what is unknown: from one iteration to the next; of Rv, none
LEAPS = (-1.0, -0.3, -0.1, 0.1, 0.3, 1.0)  # tolerances, over a kink
TRIED = 6


@dataclass(frozen=True)
class Alignment:
    """Where the sub-imagers are found to stand, in the order of measurements, and how well that is known.

    misalignments, deviations : found, and their standard deviations from the curvature
    matrix : (M, N) H so aligned;  covariance : (K, K) of all numbers that are not known beforehand, `numbers` saying
        which: (K, 2) of sub-imager and column of `misaligned.as_table`
    shifts : (N, K) how the estimate would follow each of these;  variance : (N,) what that adds to its error
    gained : how much larger the logarithm of the likelihood, with the tolerance, is than in the camera as drawn
    """

    misalignments: tuple[Misalignment, ...]
    deviations: tuple[Misalignment, ...]
    matrix: sparse.csr_array
    covariance: Matrix
    numbers: NDArray[np.intp]
    shifts: Matrix
    gained: float
    iterations: int
    converged: bool

    @cached_property
    def variance(self) -> Vector:
        """Variance of every pixel that what is left unknown of the misalignments brings: (N,), to first order."""
        return np.einsum("ik,kl,il->i", self.shifts, self.covariance, self.shifts)

    def variance_of_sum(self, weights: Vector) -> float:
        """The same of a weighted sum of pixels; weights : (N,)."""
        moved = self.shifts.T @ weights
        return float(moved @ self.covariance @ moved)


def align(
    camera: Camera, recorded: Vector, noise_variance: Vector, prior: Prior, used: NDArray[np.bool_] | None = None
) -> Alignment:
    """Find the misalignments that the camera's tolerance allows and the recorded measurements want.

    recorded, noise_variance : (m,) of the measurements that count;  used : (M,) which do, absent: all
    Raises InputError for a frame, for a camera without tolerance or with lenses of surfaces, and without noise.
    """
    recording = recording_of(camera, recorded, noise_variance, prior, used)
    end = search(recording)
    covariance = np.asarray(linalg.inv(bent(end.changes.curvature())))
    scale, found = recording.tolerances[tuple(recording.free.T)], recording.table(end.point.scores)
    return Alignment(
        as_misalignments(found),
        as_misalignments(recording.table(np.sqrt(np.diagonal(covariance)))),
        misaligned_matrix(camera, found),
        covariance * np.outer(scale, scale),
        recording.free,
        end.changes.shifts / scale,
        end.gained,
        end.iterations,
        end.converged,
    )


def recording_of(
    camera: Camera, recorded: Vector, noise_variance: Vector, prior: Prior, used: NDArray[np.bool_] | None = None
) -> MisalignedRecording:
    """What is searched, from what `align` is given and with what it raises."""
    if camera.unknowns > MOST:
        raise InputError(
            f"estimator.misalignment: 'fit' serves up to {MOST} pixels of f, got {camera.rows} x {camera.columns};"
            " take 'robust', or fit a smaller crop of the target"
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
    owner = np.repeat(np.arange(len(spread)), [place.stop - place.start for place in camera.slices()])[chosen]

    def matrix_of(table: Matrix) -> sparse.csr_array:
        return misaligned_matrix(camera, table)[chosen]

    return MisalignedRecording(recorded, noise_variance, owner, prior, matrix_of, spread)


@dataclass(frozen=True)
class SearchResult:
    """Where a search ended: the best point, derivatives there, and what was gained since the camera as drawn."""

    point: LikelihoodPoint
    changes: ParameterDerivatives
    iterations: int
    converged: bool
    gained: float


def search(recording: MisalignedRecording) -> SearchResult:
    """The point of least value, by the method of Levenberg and Marquardt.

    At first misalignment itself counts as noise, less and less of it as it becomes known, and derivatives are
    differences over what is unknown still: else numbers settle on the wrong side of a kink of H.
    """
    point = start = point_at(recording, np.zeros(len(recording.free)))
    steps, damping = np.ones(point.scores.size), DAMPING
    extra = _unexplained(point.changes(steps))
    for iteration in range(1, ITERATIONS + 1):
        extra *= COOLING if extra > COLD * float(recording.noise_variance.min()) else 0.0
        point = point_at(replace(recording, noise_variance=recording.noise_variance + extra), point.scores)
        changes = point.changes(steps)
        curvature = bent(changes.curvature(whole=False))
        better, damping = _step(point, changes.gradient, curvature, damping)
        narrower = np.clip(np.sqrt(np.diagonal(linalg.inv(curvature))), LEAST_STEP, 1.0)
        settled = extra == 0 and bool(np.all(narrower > CLOSE * steps)) and point.value - better.value < ENOUGH
        point, steps = better, narrower
        if settled:
            beyond = _beyond_a_kink(point)
            if beyond is None:
                return SearchResult(point, point.changes(steps), iteration, True, start.value - point.value)
            point = beyond
    point = point_at(recording, point.scores)
    return SearchResult(point, point.changes(steps), ITERATIONS, False, start.value - point.value)


def _beyond_a_kink(point: LikelihoodPoint) -> LikelihoodPoint | None:
    """A better point that one number alone reaches by a leap, or None; of each leap, exact values for the best few."""
    recording, size = point.recording, point.scores.size
    told: list[tuple[float, int, float]] = []
    for leap in LEAPS:
        changes = point.changes(np.full(size, leap), one_sided=True)
        expected = leap * changes.gradient + 0.5 * leap**2 * np.diagonal(changes.curvature(whole=False))
        told += [(float(expected[place]), place, leap) for place in range(size)]
    for _, place, leap in sorted(told)[:TRIED]:
        scores = point.scores.copy()
        scores[place] += leap
        other = point_at(recording, scores)
        if other.value < point.value:
            return other
    return None


def _unexplained(changes: ParameterDerivatives) -> float:
    """Variance of a measurement, on average, that misalignment within the tolerance brings."""
    variance = changes.point.recording.prior.variance
    squares = [float((change.power(2) @ variance).mean()) for change in changes.by_parameter.values()]
    return sum(squares)


def _step(point: LikelihoodPoint, gradient: Vector, curvature: Matrix, damping: float) -> tuple[LikelihoodPoint, float]:
    """A better point, or the same where there is none, and the damping to begin with next time."""
    while damping < MOST_DAMPING:
        damped = curvature + damping * np.diag(np.diagonal(curvature))
        scores = point.scores - linalg.solve(damped, gradient, assume_a="pos")
        better = point_at(point.recording, scores)
        if better.value < point.value:
            return better, max(damping / 10, LEAST_DAMPING)
        damping *= 10
    return point, DAMPING


def bent(curvature: Matrix) -> Matrix:
    """The curvature, and where it is below the tolerance's own, which is 1, that."""
    values, vectors = linalg.eigh(0.5 * (curvature + curvature.T))
    return (vectors * np.maximum(values, 1.0)) @ vectors.T
