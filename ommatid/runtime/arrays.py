"""Array types; shapes are given in the docstrings of the functions that take or return them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, shortened_repr

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def as_numbers(values: ArrayLike, name: str) -> FloatArray:
    """Return values as an array of real numbers. Raises InputError, which calls them by `name`, for other values."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array of numbers, got {shortened_repr(values)}") from error
    if array.dtype.kind not in "buif":
        raise InputError(f"{name}: expected an array of real numbers, got {shortened_repr(values)}")
    return array.astype(np.float64)
