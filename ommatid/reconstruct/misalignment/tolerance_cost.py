"""The variance that misalignment adds to an estimator that takes H as designed, known before anything is built.

A misaligned sub-imager sees D f more than expected, so that the estimate is off by A D f. Averaged over images drawn
from the prior and misalignments drawn from the tolerance, that adds to Eq. 5 the diagonals of

    A E[D (P0 + f0 f0^T) D^T] A^T  -  (I - A H) P0 E[D]^T A^T  -  its transpose,

where E[D] is not 0, since footprints that begin on the edges of pixels are blurred by displacements of either sign.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.scenes.camera import Camera

from ..expected_error import solved_columns
from ..forms.form import Form
from ..prior import Prior
from .robust_noise import MisalignmentNoise, robust_noise


def misalignment_variance(form: Form, used: BoolArray, camera: Camera, prior: Prior) -> FloatArray:
    """Return what misalignment adds to Eq. 5: (N,).

    form : of the camera's designed H, for the measurements `used`, (M,)
    """
    return mismatch_variance(form, used, robust_noise(camera, prior), camera.slices(), prior)


def mismatch_variance(
    form: Form, used: BoolArray, moments: MisalignmentNoise, slices: list[slice], prior: Prior
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
    form: Form, used: BoolArray, moments: MisalignmentNoise, slices: list[slice], image: FloatArray
) -> FloatArray:
    """Return what the same difference adds to the expected squared error of one image, (N,): (N,).

    moments : of H and of what it sees of this image, so that their prior is this image, without variance
    """
    shift, problem = _shift(form, used, moments), form.problem
    difference = image - problem.prior.mean
    bias = form.gain(problem.matrix @ difference) - difference
    seen = form.gain(shift @ image)
    added = np.square(seen) + 2 * bias * seen
    parts = _used_blocks(used, moments, slices)
    for chunk, _, _, negative in solved_columns(form, np.arange(problem.unknowns)):
        for rows, block in parts:
            added[chunk] += np.sum(negative[rows] * (block @ negative[rows]), axis=0)
    return added


def _shift(form: Form, used: BoolArray, moments: MisalignmentNoise) -> sparse.csr_array:
    """Return E[D] of the measurements used."""
    return sparse.csr_array(moments.matrix[used] - form.problem.matrix)


def _used_blocks(used: BoolArray, moments: MisalignmentNoise, slices: list[slice]) -> list[tuple[slice, FloatArray]]:
    """Return the rows among the measurements used, and the covariance of what they see, of every sub-imager."""
    if not moments.covariances:
        return []
    masks = [used[rows] for rows in slices]
    ends = np.cumsum([0, *(int(mask.sum()) for mask in masks)])
    return [
        (slice(int(first), int(last)), block[np.ix_(mask, mask)])
        for (first, last), block, mask in zip(pairwise(ends), moments.covariances, masks, strict=True)
    ]
