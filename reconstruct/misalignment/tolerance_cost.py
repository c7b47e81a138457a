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
from .robust_noise import robust_noise


def misalignment_variance(form: Form, used: BoolArray, camera: Camera, prior: Prior) -> FloatArray:
    """Return what misalignment adds to Eq. 5: (N,).

    form : of the camera's designed H, for the measurements `used`, (M,)
    """
    misaligned = robust_noise(camera, prior)
    shift = sparse.csr_array(misaligned.matrix[used] - form.problem.matrix)  # E[D]
    used_of_sub = [used[rows] for rows in camera.slices()]
    ends = np.cumsum([0, *(int(mask.sum()) for mask in used_of_sub)])
    slices = [slice(int(first), int(last)) for first, last in pairwise(ends)]
    blocks = [block[np.ix_(mask, mask)] for block, mask in zip(misaligned.covariances, used_of_sub, strict=True)]
    added = np.empty(form.problem.unknowns)
    for chunk, _, u, negative in solved_columns(form, np.arange(form.problem.unknowns)):
        shifted = shift.T @ negative
        in_prior = prior.apply_root_transposed(shifted)
        spread = np.zeros(negative.shape[1])
        for rows, block in zip(slices, blocks, strict=True):
            spread += np.sum(negative[rows] * (block @ negative[rows]), axis=0)
        added[chunk] = spread + np.square(in_prior).sum(axis=0) + np.square(prior.mean @ shifted)
        added[chunk] += 2 * np.sum(u * in_prior, axis=0)
    return added
