"""What is known of an image before any light is recorded: its mean f0 and covariance P0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scenes import scene


@dataclass(frozen=True)
class Prior:
    """Independent pixels: (N,) `mean` and (N,) `variance`, the diagonal of P0."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


def independent(prior: scene.Prior, unknowns: int) -> Prior:
    """The paper's prior: every pixel with the same mean and variance, independent of its neighbours."""
    return Prior(np.full(unknowns, prior.mean), np.full(unknowns, prior.variance))
