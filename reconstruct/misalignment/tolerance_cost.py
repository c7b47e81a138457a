"""What a camera's tolerance costs an estimator that takes H as designed: Eq. 5 with one more noise, before anything is
built.

A sub-imager that stands elsewhere sees D f more than expected, so that the estimate is off by A D f. Over images drawn
from the prior and sub-imagers as their tolerance draws them, that adds the diagonals of

    A E[D (P0 + f0 f0^T) D^T] A^T  -  (I - A H) P0 E[D]^T A^T  -  its transpose,

E[D] being other than 0 since footprints that begin on the edges of pixels blur whichever way they move.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.scenes.camera import Camera

from ..expected_error import columns
from ..forms.form import Form, Vector
from ..prior import Prior
from .robust_noise import robust_noise


def cost(form: Form, telling: NDArray[np.bool_], camera: Camera, prior: Prior) -> Vector:
    """The addition to Eq. 5, (N,); `form` is of the camera's designed H, of the measurements `telling`, (M,)."""
    told = robust_noise(camera, prior)
    shift = sparse.csr_array(told.matrix[telling] - form.problem.matrix)  # E[D]
    kept = [telling[place] for place in camera.slices()]
    ends = np.cumsum([0, *(int(some.sum()) for some in kept)])
    places = [slice(int(first), int(last)) for first, last in pairwise(ends)]
    blocks = [block[np.ix_(some, some)] for block, some in zip(told.covariances, kept, strict=True)]
    found = np.empty(form.problem.unknowns)
    for place, _, u, negative in columns(form, np.arange(form.problem.unknowns)):
        moved = shift.T @ negative
        on_average = prior.apply_root_transposed(moved)
        about_it = np.zeros(negative.shape[1])
        for rows, block in zip(places, blocks, strict=True):
            about_it += np.sum(negative[rows] * (block @ negative[rows]), axis=0)
        found[place] = about_it + np.square(on_average).sum(axis=0) + np.square(prior.mean @ moved)
        found[place] += 2 * np.sum(u * on_average, axis=0)
    return found
