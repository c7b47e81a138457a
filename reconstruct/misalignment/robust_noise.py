"""What is not known of how a camera was put together, as noise: the estimator that expects misalignment.

Let a sub-imager's H depend on numbers t that its tolerance spreads. With D = H(t) - E[H], images of mean f0 and
covariance P0, and t independent of the image, measurements have the moments

    mean E[H] f0,   covariance with f  P0 E[H]^T,   covariance  E[H] P0 E[H]^T + E[D (P0 + f0 f0^T) D^T] + Rv.

So the best linear estimator is Eq. 4 of Wood et al. with E[H] for H and one dense block more of noise for each
sub-imager, and Eq. 5 with both holds on average over images and cameras. E[H] is a little blurred.

H is piecewise smooth: it has a kink wherever a sensor pixel's edge meets a texel's, and in the camera as drawn all
edges meet. A derivative there says little, so moments are sums over points on either side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse, special, stats

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.blur import blur_of
from ommatid.scenes.optics.footprints import matrix as footprints
from ommatid.scenes.pose import Misalignment, pose_of

from ..expected_error import ExpectedError
from ..forms.form import Form
from ..prior import Prior
from ..problem import Problem

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

PARAMETERS = 6  # position x and y, tilt about x and about y, rotation, focal length: the columns of every table here
POINTS = 3  # on either side: right for polynomials to degree 5 between zero and where the next edges meet
DRAWN = 32  # pairs of points where more than offsets is misaligned
CHUNK = 512


@dataclass(frozen=True)
class MisalignmentNoise:
    """E[H] as `matrix`, (M, N), and `covariances`, for each sub-imager E[D (P0 + f0 f0^T) D^T], (pixels, pixels)."""

    matrix: sparse.csr_array
    covariances: tuple[Matrix, ...]

    @property
    def variance(self) -> Vector:
        """What misalignment adds to the variance of each measurement: (M,)."""
        return np.concatenate([np.diagonal(block) for block in self.covariances])


def tolerances(camera: Camera) -> Matrix:
    """Standard deviations of all that may be misaligned: (sub-imagers, 6). Raises InputError for blurred lenses."""
    for kind in camera.types:
        if kind.optics.surfaces is not None or not blur_of(camera, kind).none:
            raise InputError(
                f"camera.lens.{kind.name}: H of misaligned lenses is known of pinholes and of thin ones in focus"
                " without a camera.wavelength, got another lens; take estimator.misalignment = 'trust'"
            )
    told = camera.tolerance
    if told is None:
        return np.zeros((len(camera.sub_imagers), PARAMETERS))
    position, tilt = told.position or 0.0, told.tilt or 0.0
    row = [position, position, tilt, tilt, told.rotation or 0.0, told.focal_length or 0.0]
    return np.tile(row, (len(camera.sub_imagers), 1))


def as_table(wrong: tuple[Misalignment, ...]) -> Matrix:
    """Misalignments as numbers: (sub-imagers, 6)."""
    return np.array([[*one.position, *one.tilt, one.rotation, one.focal_length] for one in wrong])


def as_misalignments(table: Matrix) -> tuple[Misalignment, ...]:
    """And back."""
    rows = [[float(number) for number in row] for row in table]
    return tuple(
        Misalignment((x, y), (about_x, about_y), turn, longer) for x, y, about_x, about_y, turn, longer in rows
    )


def misaligned_matrix(camera: Camera, table: Matrix) -> sparse.csr_array:
    """H of a camera whose sub-imagers are misaligned so: (sub-imagers, 6) to (M, N)."""
    pairs = zip(camera.sub_imagers, as_misalignments(table), strict=True)
    return footprints(camera, tuple(pose_of(sub, wrong) for sub, wrong in pairs))


def robust_noise(
    camera: Camera, prior: Prior, deviations: Matrix | None = None, middle: Matrix | None = None
) -> MisalignmentNoise:
    """E[H] and what misalignment adds to the noise, for images drawn from the prior.

    deviations : (sub-imagers, 6), absent: the camera's tolerance;  middle : (sub-imagers, 6) of the misalignments
        around which they lie, absent: zeros, the camera as drawn
    Numbers are independent and normal.
    """
    spread = tolerances(camera) if deviations is None else deviations
    around = np.zeros_like(spread) if middle is None else middle
    start = misaligned_matrix(camera, around)
    places = camera.slices()
    blocks = [np.zeros((place.stop - place.start,) * 2) for place in places]
    mean = start
    for group in _groups(np.asarray(spread.any(axis=0))):
        shift = sparse.csr_array(start.shape)
        for weight, scores in group:
            change = sparse.csr_array(misaligned_matrix(camera, around + scores * spread) - start)
            shift = shift + weight * change
            _add_squares(blocks, places, change, prior, weight)
        _add_squares(blocks, places, shift, prior, -1.0)
        mean = mean + shift
    return MisalignmentNoise(sparse.csr_array(mean), tuple(blocks))


@dataclass(frozen=True)
class Whitening:
    """Cholesky factors K of the blocks of a block-diagonal Rv, with which K^-1 g has unit noise."""

    places: tuple[slice, ...]
    factors: tuple[Matrix, ...]

    def vector(self, recorded: Vector) -> Vector:
        """K^-1 g: (M,)."""
        white = np.empty_like(recorded)
        for place, factor in zip(self.places, self.factors, strict=True):
            white[place] = linalg.solve_triangular(factor, recorded[place], lower=True, check_finite=False)
        return white

    def matrix(self, matrix: sparse.csr_array) -> sparse.csr_array:
        """K^-1 H: (M, N); a row sees all that its sub-imager sees."""
        parts: list[sparse.csr_array] = []
        for place, factor in zip(self.places, self.factors, strict=True):
            part = sparse.csc_array(matrix[place])
            seen = np.flatnonzero(np.diff(part.indptr))
            white = linalg.solve_triangular(factor, part[:, seen].toarray(), lower=True, check_finite=False)
            rows = np.arange(0, white.size + 1, seen.size)
            indices = np.tile(seen, white.shape[0])
            parts.append(sparse.csr_array((np.asarray(white).ravel(), indices, rows), shape=part.shape))
        return sparse.csr_array(sparse.vstack(parts, format="csr"))

    def multipliers(self, white: Matrix) -> Matrix:
        """K^-T l: multipliers of the whitened problem, (M,) or (M, q), as those of the problem itself."""
        found = np.empty_like(white)
        for place, factor in zip(self.places, self.factors, strict=True):
            found[place] = linalg.solve_triangular(factor, white[place], trans="T", lower=True, check_finite=False)
        return found

    def problem(self, matrix: sparse.csr_array, prior: Prior) -> Problem:
        """What any form of the estimator solves: K^-1 H with unit noise, to which K^-1 g belongs."""
        return Problem(self.matrix(matrix), prior, np.ones(matrix.shape[0]))


def whitening(
    camera: Camera, misaligned: MisalignmentNoise, noise_variance: Vector, used: NDArray[np.bool_] | None = None
) -> Whitening:
    """Of misalignment and independent noise together.

    used : (M,) which measurements count, absent: all;  noise_variance : (pixels used,)
    Raises InputError where some noise is missing, so that misalignment makes a block singular.
    """
    chosen = np.ones(camera.measurements, dtype=np.bool_) if used is None else used
    places: list[slice] = []
    factors: list[Matrix] = []
    start = 0
    for place, covariance in zip(camera.slices(), misaligned.covariances, strict=True):
        some = chosen[place]
        here = slice(start, start + int(some.sum()))
        block = covariance[np.ix_(some, some)] + np.diag(noise_variance[here])
        try:
            factors.append(np.asarray(linalg.cholesky(block, lower=True)))
        except linalg.LinAlgError:
            raise InputError(
                "estimator.misalignment = 'robust' needs noise in every measurement, got some without;"
                " set noise.variance or estimator.noise_variance to a number above 0"
            ) from None
        places.append(here)
        start = here.stop
    return Whitening(tuple(places), tuple(factors))


def robust_error(form: Form, white: Whitening, noise: dict[str, Vector], cause: str = "misalignment") -> ExpectedError:
    """Eq. 5 of a form of the whitened problem, over images and misalignments as they are drawn.

    noise : named (pixels used,) variances that together are the independent part of what was whitened; what is left
        of the error that measurements bring is that of `cause`
    """
    count = form.problem.unknowns
    by_column = sparse.csc_array(form.problem.matrix)
    variance, resolved = np.zeros(count), np.zeros(count)
    missing = brought = 0.0
    weights = np.zeros(form.problem.measurements)
    for start in range(0, count, CHUNK):
        some = np.arange(start, min(start + CHUNK, count))
        u, negative = form.pixel_solutions(some)
        prior, noisy = np.square(u).sum(axis=0), np.square(negative).sum(axis=0)
        variance[some] = prior + noisy
        missing, brought = missing + float(prior.sum()) / count, brought + float(noisy.sum()) / count
        resolved[some] = -np.asarray(by_column[:, some].multiply(negative).sum(axis=0)).ravel()
        weights += np.square(white.multipliers(negative)).sum(axis=1) / count
    parts = {name: float(weights @ values) for name, values in noise.items()}
    return ExpectedError(variance, missing, {**parts, cause: max(brought - sum(parts.values()), 0.0)}, resolved)


def _groups(free: NDArray[np.bool_]) -> list[list[tuple[float, Vector]]]:
    """Weights and points, (6,) in standard deviations, of the numbers that are `free`; what groups bring adds up.

    Offsets in x and in y move other edges of a pixel, so one after the other will do. All else moves the same edges,
    and kinks are where all of it together is nothing: then points are drawn evenly from all numbers at once.
    """
    numbers = np.flatnonzero(free)
    if (numbers < 2).all():
        sides = [(sign, node, weight) for node, weight in zip(*half_normal(POINTS), strict=True) for sign in (-1, 1)]
        units = np.eye(PARAMETERS)
        return [[(weight / 2, sign * node * units[number]) for sign, node, weight in sides] for number in numbers]
    even = stats.qmc.Sobol(numbers.size, rng=np.random.default_rng(0)).random(DRAWN)
    points = np.zeros((2 * DRAWN, PARAMETERS))
    points[:, numbers] = np.concatenate([stats.norm.ppf(even), -stats.norm.ppf(even)])
    return [[(0.5 / DRAWN, point) for point in points]]


def half_normal(points: int) -> tuple[Vector, Vector]:
    """Gauss's nodes and weights for the modulus of a standard normal number: right to degree 2 `points` - 1.

    A normal number's own would take a kink at zero for a curve, and 3 of them get E|t| wrong by a tenth and more.
    """
    order = np.arange(2 * points)
    moments: Vector = 2 ** (order / 2) * special.gamma((order + 1) / 2) / np.pi**0.5
    square = np.array([moments[row : row + points] for row in range(points)])
    monic = np.concatenate([np.linalg.solve(square, -moments[points:]), [1.0]])
    nodes = np.sort(np.roots(monic[::-1]).real)
    weights = np.linalg.solve(np.vander(nodes, increasing=True).T, moments[:points])
    return np.asarray(nodes, dtype=np.float64), np.asarray(weights, dtype=np.float64)


def _add_squares(
    blocks: list[Matrix], places: list[slice], change: sparse.csr_array, prior: Prior, weight: float
) -> None:
    """Add weight D (P0 + f0 f0^T) D^T of every sub-imager to its block."""
    of_mean: Vector = change @ prior.mean
    for block, place in zip(blocks, places, strict=True):
        some = change[place]
        if prior.independent:
            thin = sparse.csr_array(some.multiply(prior.root[None, :]))
            square = np.asarray(sparse.csr_array(thin @ thin.T).toarray())
        else:
            wide: Matrix = some @ prior.root
            square = wide @ wide.T
        block += weight * (square + np.outer(of_mean[place], of_mean[place]))
