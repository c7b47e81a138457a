"""What a camera's tolerance costs an estimator that takes H as designed: Eq. 5 with one more noise, before anything is
built.

A sub-imager that stands elsewhere sees D f more than expected, so that the estimate is off by A D f. Over images drawn
from the prior and sub-imagers as their tolerance draws them, that adds the diagonals of

    A E[D (P0 + f0 f0^T) D^T] A^T  -  (I - A H) P0 E[D]^T A^T  -  its transpose,

E[D] being other than 0 since footprints that begin on the edges of pixels blur whichever way they move.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from scenes.camera import Camera

from .expected import columns
from .forms.form import Form, Vector
from .misaligned import robust_noise
from .prior import Prior


def cost(form: Form, camera: Camera, prior: Prior) -> Vector:
    """The addition to Eq. 5, (N,); `form` is of all measurements with the camera's designed H."""
    told = robust_noise(camera, prior)
    shift, places = sparse.csr_array(told.matrix - form.problem.matrix), camera.slices()  # E[D]
    found = np.empty(form.problem.unknowns)
    for place, _, u, negative in columns(form, np.arange(form.problem.unknowns)):
        moved = shift.T @ negative
        on_average = prior.gather(moved)
        about_it = np.zeros(negative.shape[1])
        for rows, block in zip(places, told.covariances, strict=True):
            about_it += np.sum(negative[rows] * (block @ negative[rows]), axis=0)
        found[place] = about_it + np.square(on_average).sum(axis=0) + np.square(prior.mean @ moved)
        found[place] += 2 * np.sum(u * on_average, axis=0)
    return found
