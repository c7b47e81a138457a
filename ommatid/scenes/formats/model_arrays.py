"""The arrays of a model's file, checked: types and shapes before they are read, numbers afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..tables.table import LARGEST
from .npz import Header, Headers

ENTRIES = ("indices", "indptr", "data")
MOST_BATCHES = 1024
MOST_TEXTS = 100
LONGEST_TEXT = 2**26  # bytes of a text, four a character
EXPECTED = {  # dimensions, kinds and bytes of a number
    **dict.fromkeys(("data", "variance"), (1, "f", (4, 8))),
    "batches": (2, "f", (4, 8)),
    "shape": (1, "i", (4, 8)),
    **dict.fromkeys(("indices", "indptr"), (1, "i", (4, 8))),
}


def check_headers(headers: Headers) -> None:
    """Raise ValueError for arrays that no model has, before any of them is read."""
    for name, (shape, dtype) in headers.items():
        if name in EXPECTED:
            dimensions, kinds, sizes = EXPECTED[name]
            if len(shape) != dimensions or dtype.kind not in kinds or dtype.itemsize not in sizes:
                raise ValueError(f"{name} is of type {dtype} and shape {shape}")
        elif dtype.kind in "US" and (int(np.prod(shape)) > MOST_TEXTS or dtype.itemsize > LONGEST_TEXT):
            raise ValueError(f"{name} has {dtype} texts of shape {shape}")
    if "shape" in headers and headers["shape"].shape != (2,):
        raise ValueError(f"shape is of shape {headers['shape'].shape}")
    if "batches" in headers and headers["batches"].shape[0] > MOST_BATCHES:
        raise ValueError(f"it has {headers['batches'].shape[0]} batches, more than {MOST_BATCHES}")
    _check_lengths(headers)


def _check_lengths(headers: Mapping[str, Header]) -> None:
    """Raise ValueError unless all arrays of entries are equally long."""
    if "data" not in headers:
        return
    entries = headers["data"].shape
    for name in ("indices", "variance", "batches"):
        if name in headers and headers[name].shape[-1:] != entries:
            raise ValueError(f"{name} is of shape {headers[name].shape} for {entries[0]} entries")


def csr_matrix(arrays: Mapping[str, NDArray[Any]], shape: tuple[int, ...]) -> sparse.csr_array:
    """H from its arrays, float64.

    Raises ValueError if they form no CSR matrix in canonical form, whose entries ascend in each row and stand there
    once, or if they hold values out of range: a variance of an entry that stands twice would be counted wrongly.
    """
    for name in ("data", "variance", "batches"):
        check_range(name, arrays[name])
    if (arrays["variance"] < 0).any():
        raise ValueError("a variance is below 0")
    data, indices, indptr = arrays["data"].astype(np.float64, copy=False), arrays["indices"], arrays["indptr"]
    if min(shape) < 0 or len(indptr) != shape[0] + 1 or indptr[0] != 0 or indptr[-1] != len(indices):
        raise ValueError(f"its rows end at other entries than those of a matrix of shape {shape}")
    matrix = sparse.csr_array((data, indices, indptr), shape=(shape[0], shape[1]))
    matrix.check_format(full_check=True)
    if not matrix.has_canonical_format:
        raise ValueError("expected the entries of a row by ascending column, each once")
    return matrix


def check_range(name: str, values: NDArray[Any]) -> None:
    """Raise ValueError for numbers that are not finite, or too large for their squares."""
    if values.size and not (values.min() >= -(LARGEST**2) and values.max() <= LARGEST**2):
        raise ValueError(f"{name} has values that are not finite or out of range")
