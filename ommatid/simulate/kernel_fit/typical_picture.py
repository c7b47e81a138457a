"""Errors of kernels as a typical picture shows them."""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray

LEVEL = 3.0  # mean squared over variance of a picture whose values are uniform between 0 and 255
CORRELATED = 3.0  # pixels of f over which a picture's correlation falls to 1/e


def seen(errors: FloatArray) -> FloatArray:
    """Return errors of kernels, (..., C), in coordinates whose squares add up to the variance of H f: (..., C + 1).

    The picture has a variance of 1, and a correlation that falls exponentially down and across.
    """
    size = round(errors.shape[-1] ** 0.5)
    place = np.arange(size, dtype=np.float64)
    apart = np.abs(place[:, None] - place)
    values, vectors = np.linalg.eigh(np.exp(-apart / CORRELATED))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    varied = root @ errors.reshape(*errors.shape[:-1], size, size) @ root
    level = LEVEL**0.5 * errors.sum(axis=-1, keepdims=True)
    return np.concatenate([varied.reshape(errors.shape), level], axis=-1)
