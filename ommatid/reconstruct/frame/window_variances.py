"""Posterior variances of a frame of any size for any H and any noise, from windows side by side.

The inverse of K decays within some ten pixels, so that the variances in the core of a window depend on K in the window
alone, once a halo surrounds the core; pixels beyond the halo count as known. What the halo leaves out is known for even
noise, where the variance far from the edges follows from the transfer function, and is corrected by that ratio. At an
edge outside the field of some lens types errors are correlated over any distance along it, so that the windows along
the edges are as long as these.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.processors import one_thread, processors

from .selected_inverse import stencil_variances
from .stencil import Source, Stencil, half_offsets, reach_of

CORE = 24  # columns of a window whose variances it gives
LENGTH = 256  # its rows
BESIDE = 4  # rows and columns by which the strips along edges give more than the halo


@dataclass(frozen=True)
class EvenNoise:
    """K of a pixel far from the edges where noise is even, (offsets,) as in a stencil, and its posterior variance."""

    couplings: FloatArray
    variance: float


def frame_variances(
    source: Source, shape: tuple[int, int], halo: int, even: EvenNoise | None = None, known: FloatArray | None = None
) -> FloatArray:
    """Return the diagonal of K^-1 for the pixels of a frame: (rows, columns).

    source : K of any window;  halo : pixels around the core of a window
    even : of similar noise, to correct what the halo leaves out; None where that is nothing
    known : variances far from the edges that need no window, (rows, columns), NaN where they do
    Windows are computed in parallel, each by one thread.
    """
    margin = halo + BESIDE
    with one_thread():
        if min(shape) <= 2 * (margin + halo):
            return _strip_variances(source, slice(0, shape[0]), slice(0, shape[1]))
        variance, inner = np.zeros(shape), (slice(margin, -margin), slice(margin, -margin))
        variance[inner] = np.nan if known is None else known[inner]
        size = min(LENGTH, shape[0] - 2 * margin), min(CORE, shape[1] - 2 * margin)
        correction = None
        with ThreadPoolExecutor(processors()) as threads:
            for top in _starts(margin, shape[0] - margin, size[0]):
                unknown = np.isnan(variance[top : top + size[0]])
                lefts = [
                    left
                    for left in _starts(margin, shape[1] - margin, size[1])
                    if unknown[:, left : left + size[1]].any()
                ]
                if not lefts:
                    continue
                if correction is None:
                    correction = 1.0 if even is None else _correction(even, size, halo)
                slab = source(slice(top - halo, top + size[0] + halo), slice(0, shape[1]))
                windows = [slab.columns(slice(left - halo, left + size[1] + halo)) for left in lefts]
                for left, part in zip(lefts, threads.map(stencil_variances, windows), strict=True):
                    core = part[halo:-halo, halo:-halo] * correction
                    variance[top : top + size[0], left : left + size[1]] = core
        _add_edges(variance, source, margin, halo)
    return variance


def _starts(first: int, end: int, size: int) -> list[int]:
    """Return the first pixels of windows of `size` pixels that cover an axis from `first` to `end`."""
    return [min(start, end - size) for start in range(first, end, size)]


def _correction(even: EvenNoise, size: tuple[int, int], halo: int) -> FloatArray:
    """Return the ratio of the variance with even noise in a frame to that of a window: (rows, columns) of its core."""
    window = np.empty((even.couplings.size, size[0] + 2 * halo, size[1] + 2 * halo))
    window[:] = even.couplings[:, None, None]
    reach = reach_of(even.couplings.size)
    for values, (down, _) in zip(window, half_offsets(reach), strict=True):
        values[window.shape[1] - down :] = 0.0  # the rows below are known
    return even.variance / stencil_variances(Stencil(window, reach))[halo:-halo, halo:-halo]


def _add_edges(variance: FloatArray, source: Source, margin: int, halo: int) -> None:
    """Fill the margins from strips along each edge; pixels beyond a strip count as known: none is too large."""
    rows, columns = variance.shape
    deep = margin + halo
    broad = [slice(0, rows), slice(0, rows), slice(0, deep), slice(rows - deep, rows)]
    long = [slice(0, deep), slice(columns - deep, columns), slice(0, columns), slice(0, columns)]
    with ThreadPoolExecutor(min(processors(), 2)) as threads:  # each takes much memory
        left, right, top, bottom = threads.map(partial(_strip_variances, source), broad, long)
    upright = left[:, :margin], right[:, -margin:]
    for view, part in ((variance[:, :margin], upright[0]), (variance[:, -margin:], upright[1])):
        view[:] = part
    for view, part in ((variance[:margin], top[:margin]), (variance[-margin:], bottom[-margin:])):
        np.maximum(view, part, out=view)


def _strip_variances(source: Source, rows: slice, columns: slice) -> FloatArray:
    """Return the variances of a window whose surroundings are known, by one sweep along its longer side."""
    stencil = source(rows, columns)
    upright = columns.stop - columns.start <= rows.stop - rows.start
    return stencil_variances(stencil) if upright else stencil_variances(stencil.transposed()).T
