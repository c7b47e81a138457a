"""Misalignment within a known tolerance: the moments of H, and what it costs an estimator that does not expect it.

Let a sub-imager's H depend on parameters t, distributed as its tolerance says. With D = H(t) - E[H], images of mean f0
and covariance P0, and t independent of the image, readings have the mean E[H] f0, and beside Rv the covariance

    E[H] P0 E[H]^T + E[D (P0 + f0 f0^T) D^T].

H is piecewise smooth: edges of sensor pixels move by sums of parameters, and H has a kink wherever one coincides with
an edge of a texel, as all do in the camera as designed. A derivative there is of little use, so moments are sums over
points on either side. Second moments of H follow from the second moments of the parameters, its mean from their
absolute values. So the points are an orthogonal array of strength 2 (Bose and Bush 1952): every parameter takes the
same levels, and every two of them all pairs of levels equally often. Means of products of functions of two parameters
are therefore products of means, and the levels give E|t|, E t^2 and E|t|^3 of a normal variable exactly. A parameter
has the same levels whatever others there are, so that a vanishing tolerance changes nothing.

With D' = H(t) minus the estimator's H, the estimate is off by A D' f. Averaged over images drawn from the prior and
misalignments drawn from the tolerance, that adds to Eq. 5 the diagonals of

    A E[D' (P0 + f0 f0^T) D'^T] A^T  -  (I - A H) P0 E[D']^T A^T  -  its transpose.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.footprints import matrix as footprints
from ommatid.scenes.pose import Misalignment, pose_of

from ..expected_error import solved_columns
from ..prior import Prior
from ..problem import Form

# |t| at a quarter of the points each, in standard deviations: the solution of three equations for the mean of |t|,
# t^2 and |t|^3 with two equal levels. E t^4 is 2.78 instead of 3: no four real levels have all four moments.
MAGNITUDES = (0.5615901610541997, 0.2499019887107961, 0.5615901610541997, 1.818455932392266)
# Columns of the array, one for each parameter; of all choices these have the least error of E|sum| over random sums.
COLUMNS = (0, 1, 2, 3, 4, 7)
ORDER = 8  # of the Galois field, and number of signed levels
MODULUS = 0b1011  # x^3 + x + 1
PARAMETERS = 6  # position x and y, tilt about x and about y, rotation, focal length: the columns of every table here
CAUSE = "misalignment"  # in the error budget


def points_of(free: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights, (points,), and the points, (points, 6) in standard deviations, of the parameters `free`.

    Parameters that are not free are 0. Every point's opposite is among the points.
    """
    a, b = (index.ravel() for index in np.indices((ORDER, ORDER)))
    table = np.array([[_product(first, second) for second in range(ORDER)] for first in range(ORDER)])
    levels = a[:, None] ^ table[b][:, list(COLUMNS)]
    scores = np.array(MAGNITUDES)[levels >> 1] * np.where(levels & 1, 1.0, -1.0) * free
    points, counts = np.unique(scores + 0.0, axis=0, return_counts=True)
    return np.asarray(counts / ORDER**2, dtype=np.float64), np.asarray(points, dtype=np.float64)


def _product(first: int, second: int) -> int:
    """Return the product of two elements of the field of 8 elements, polynomials over the field of 2."""
    product = 0
    for power in range(3):
        product ^= (first << power) * (second >> power & 1)
    for power in (4, 3):
        product ^= (MODULUS << (power - 3)) * (product >> power & 1)
    return product


@dataclass(frozen=True)
class MisalignedMoments:
    """E[H] as `matrix`, (M, N), and `covariances`, for each sub-imager E[D (P0 + f0 f0^T) D^T], (pixels, pixels)."""

    matrix: sparse.csr_array
    covariances: tuple[FloatArray, ...]


def tolerances(camera: Camera) -> FloatArray:
    """Return the standard deviations of all parameters: (sub-imagers, 6). Raises InputError for blurred lenses."""
    for lens_type in camera.types:
        if camera.is_blurred(lens_type):
            raise InputError(
                f"camera.lens.{lens_type.name}: H of misaligned lenses is known of pinholes and of thin ones in focus"
                " without a camera.wavelength, got another lens; take estimator.misalignment = 'trust'"
            )
    tolerance = camera.tolerance
    if tolerance is None:
        return np.zeros((len(camera.sub_imagers), PARAMETERS))
    position, tilt = tolerance.position or 0.0, tolerance.tilt or 0.0
    row = [position, position, tilt, tilt, tolerance.rotation or 0.0, tolerance.focal_length or 0.0]
    return np.tile(row, (len(camera.sub_imagers), 1))


def as_misalignments(table: FloatArray) -> tuple[Misalignment, ...]:
    """Return a table, (sub-imagers, 6), as misalignments."""
    rows = [[float(number) for number in row] for row in table]
    return tuple(
        Misalignment((x, y), (about_x, about_y), rotation, focal_length)
        for x, y, about_x, about_y, rotation, focal_length in rows
    )


def misaligned_matrix(camera: Camera, table: FloatArray) -> sparse.csr_array:
    """Return H, (M, N), of a camera with these misalignments, (sub-imagers, 6)."""
    pairs = zip(camera.sub_imagers, as_misalignments(table), strict=True)
    return footprints(camera, tuple(pose_of(sub, misalignment) for sub, misalignment in pairs))


def misaligned_moments(camera: Camera, prior: Prior) -> MisalignedMoments:
    """Return the moments of H and of what it sees of images drawn from the prior.

    The parameters are independent normal ones, with the camera's tolerance for their standard deviations.
    """
    spread = tolerances(camera)
    design = np.zeros_like(spread)
    start = misaligned_matrix(camera, design)
    slices = camera.slices()
    blocks = [np.zeros((rows.stop - rows.start,) * 2) for rows in slices]
    mean = start
    if spread.any():
        shift = sparse.csr_array(start.shape)
        for weight, scores in zip(*points_of(np.asarray(spread.any(axis=0))), strict=True):
            change = sparse.csr_array(misaligned_matrix(camera, design + scores * spread) - start)
            shift = shift + weight * change
            _add_squares(blocks, slices, change, prior, weight)
        _add_squares(blocks, slices, shift, prior, -1.0)
        mean = start + shift
    return MisalignedMoments(sparse.csr_array(mean), tuple(blocks))


def _add_squares(
    blocks: list[FloatArray], slices: list[slice], change: sparse.csr_array, prior: Prior, weight: float
) -> None:
    """Add weight D (P0 + f0 f0^T) D^T of every sub-imager to its block."""
    of_mean: FloatArray = change @ prior.mean
    for block, rows in zip(blocks, slices, strict=True):
        part = change[rows]
        if prior.independent:
            scaled = sparse.csr_array(part.multiply(prior.root[None, :]))
            square = np.asarray(sparse.csr_array(scaled @ scaled.T).toarray())
        else:
            root: FloatArray = part @ prior.root
            square = root @ root.T
        block += weight * (square + np.outer(of_mean[rows], of_mean[rows]))


def mismatch_variance(
    form: Form, used: BoolArray, moments: MisalignedMoments, slices: list[slice], prior: Prior
) -> FloatArray:
    """Return what the difference of the camera's H from the form's adds to Eq. 5, for images of the prior: (N,).

    moments : of H and of what it sees of such images, for all measurements;  slices : of their blocks
    prior : the actual one, whose covariance is a multiple of the form's
    """
    stretch = float(np.sqrt(prior.variance.sum() / form.problem.prior.variance.sum()))
    shift, parts = _shift(form, used, moments), _used_blocks(used, moments, slices)
    added = np.empty(form.problem.unknowns)
    for chunk, _, u, negative in solved_columns(form, np.arange(form.problem.unknowns)):
        shifted = shift.T @ negative
        in_prior = prior.apply_root_transposed(shifted)
        spread = np.zeros(negative.shape[1])
        for rows, block in parts:
            spread += np.sum(negative[rows] * (block @ negative[rows]), axis=0)
        added[chunk] = spread + np.square(in_prior).sum(axis=0) + np.square(prior.mean @ shifted)
        added[chunk] += 2 * stretch * np.sum(u * in_prior, axis=0)
    return added


def mismatch_of_image(
    form: Form, used: BoolArray, moments: MisalignedMoments, slices: list[slice], image: FloatArray
) -> FloatArray:
    """Return what the same difference adds to the expected squared error of one image, (N,): (N,).

    moments : of H and of what it sees of this image, so that their prior is this image, without variance
    """
    problem = form.problem
    difference = image - problem.prior.mean
    bias = form.gain(problem.matrix @ difference) - difference
    of_image = Prior(image, np.zeros(image.size))
    squares = mismatch_variance(form, used, moments, slices, of_image)
    return squares + 2 * bias * form.gain(_shift(form, used, moments) @ image)


def _shift(form: Form, used: BoolArray, moments: MisalignedMoments) -> sparse.csr_array:
    """Return E[D] of the measurements used."""
    return sparse.csr_array(moments.matrix[used] - form.problem.matrix)


def _used_blocks(used: BoolArray, moments: MisalignedMoments, slices: list[slice]) -> list[tuple[slice, FloatArray]]:
    """Return the rows among the measurements used, and the covariance of what they see, of every sub-imager."""
    if not moments.covariances:
        return []
    masks = [used[rows] for rows in slices]
    ends = np.cumsum([0, *(int(mask.sum()) for mask in masks)])
    return [
        (slice(int(first), int(last)), block[np.ix_(mask, mask)])
        for (first, last), block, mask in zip(pairwise(ends), moments.covariances, masks, strict=True)
    ]
