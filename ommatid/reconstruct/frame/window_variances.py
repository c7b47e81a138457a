"""Posterior variances of a frame of any size for any H and any noise, from windows side by side.

The precision K = H^T W H + p I of a frame couples only pixels that one sensor pixel sees. It is held as a stencil: the
couplings of each pixel (r, c) to (r + i, c + j) for offsets with i > 0, or i = 0 and j >= 0; the others follow by
symmetry. In blocks of lines K is block tridiagonal, and the diagonal of its inverse needs no inverse of its size
(Takahashi, Fagan and Chin 1973): a forward sweep eliminates the blocks (block Cholesky), a backward sweep computes the
diagonal blocks of the inverse.

The inverse of K decays within some ten pixels, so that the variances in the core of a window depend on K in the window
alone, once a halo surrounds the core; pixels beyond the halo count as known. What the halo leaves out is known for even
noise, where the variance far from the edges follows from the transfer function, and is corrected by that ratio. At an
edge outside the field of some lens types errors are correlated over any distance along it, so that the windows along
the edges are as long as these.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from math import isqrt

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import one_thread, processors
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

Places = NDArray[np.intp]

CORE = 24  # columns of a window whose variances it gives
LENGTH = 256  # its rows
BESIDE = 4  # rows and columns by which the strips along edges give more than the halo


@dataclass(frozen=True)
class Stencil:
    """K of a rectangle of pixels.

    values : (offsets, rows, columns), in the order of `half_offsets(reach)`; 0 where the other pixel lies outside
    reach : largest distance of coupled pixels, in rows and in columns
    """

    values: FloatArray
    reach: int

    def columns(self, part: slice) -> Stencil:
        """Return K of some columns; the pixels beside them are known, so that they drop out."""
        return Stencil(self.values[:, :, part], self.reach)

    def transposed(self) -> Stencil:
        """Return K of the transposed image."""
        rows, columns = self.values.shape[1:]
        offsets = half_offsets(self.reach)
        index = {offset: number for number, offset in enumerate(offsets)}
        turned = np.zeros((len(offsets), columns, rows))
        for values, (down, across) in zip(self.values, offsets, strict=True):
            if across > 0 or (across == 0 and down >= 0):
                turned[index[across, down]] = values.T
            elif rows > down and columns > -across:  # the same coupling, seen from the other pixel
                turned[index[-across, -down], : columns + across, down:] = values[: rows - down, -across:].T
        return Stencil(turned, self.reach)


Source = Callable[[slice, slice], Stencil]  # from rows and columns of a frame to K of this window


def half_offsets(reach: int) -> list[tuple[int, int]]:
    """Return the offsets, in rows and columns, up to `reach` that stand for all by symmetry."""
    return [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if i or j >= 0]


def reach_of(offsets: int) -> int:
    """Return the reach of a stencil from its number of offsets, ((2 reach + 1)^2 + 1) / 2."""
    return (isqrt(2 * offsets - 1) - 1) // 2


def box_stencil(camera: Camera, weights: FloatArray, prior: float, rows: slice, columns: slice) -> Stencil:
    """Return K of a window for the ideal H of shift-invariant lens types, whose sensor pixels average all boxes.

    weights : (M,) diagonal of W
    """
    reach = max(int(lens_type.ratio) for lens_type in camera.types) - 1
    values = np.zeros((len(half_offsets(reach)), rows.stop - rows.start, columns.stop - columns.start))
    for lens_type, part in zip(camera.types, camera.type_slices(), strict=True):
        width = int(lens_type.ratio)
        _add_boxes(values, reach, width, _placed(lens_type, weights[part], rows, columns) / width**4)
    values[0] += prior
    return Stencil(values, reach)


def even_couplings(widths: list[int], weights: tuple[float, ...], prior: float, reach: int) -> FloatArray:
    """Return K between a pixel far from the edges and its neighbours, (offsets,), for even weights of each type.

    widths : of the boxes of each type, at most reach + 1
    """
    couplings = np.zeros(len(half_offsets(reach)))
    for width, weight in zip(widths, weights, strict=True):
        for number, (down, across) in enumerate(half_offsets(reach)):
            couplings[number] += weight * max(width - down, 0) * max(width - abs(across), 0) / width**4
    couplings[0] += prior
    return couplings


def box_image(lens_type: LensType, weights: FloatArray) -> FloatArray:
    """Return the weights of a shift-invariant type's measurements by the place of the first pixel of each box."""
    sub_rows, sub_columns = lens_type.array
    pixel_rows, pixel_columns = lens_type.pixels
    grid = weights.reshape(sub_rows, sub_columns, pixel_rows, pixel_columns)
    return grid.transpose(2, 0, 3, 1).reshape(pixel_rows * sub_rows, pixel_columns * sub_columns)


def _placed(lens_type: LensType, weights: FloatArray, rows: slice, columns: slice) -> FloatArray:
    """Return the weights of the boxes that touch a window by their first pixel, from m - 1 pixels before it on."""
    boxes, before = box_image(lens_type, weights), int(lens_type.ratio) - 1
    firsts = rows.start - before, columns.start - before
    placed = np.zeros((rows.stop - firsts[0], columns.stop - firsts[1]))
    origins = [int(first) for first in lens_type.origin]
    ends = [
        (max(origin, first), min(origin + size, part.stop))
        for origin, first, size, part in zip(origins, firsts, boxes.shape, (rows, columns), strict=True)
    ]
    if all(low < high for low, high in ends):
        inside = tuple(slice(low - first, high - first) for (low, high), first in zip(ends, firsts, strict=True))
        taken = tuple(slice(low - origin, high - origin) for (low, high), origin in zip(ends, origins, strict=True))
        placed[inside] = boxes[taken]
    return placed


def _add_boxes(values: FloatArray, reach: int, width: int, placed: FloatArray) -> None:
    """Add the couplings of a lens type: sums of `placed` over all boxes that hold both pixels."""
    rows, columns = values.shape[1:]
    index = {offset: number for number, offset in enumerate(half_offsets(reach))}
    for down in range(min(width, rows)):
        # Boxes that hold rows r and r + down begin at r + down - (m - 1) to r, so at places r + down to r + m - 1.
        sums = np.sum([placed[shift : shift + rows - down] for shift in range(down, width)], axis=0)
        for across in range(min(width, columns)):
            both = np.sum([sums[:, shift : shift + columns - across] for shift in range(across, width)], axis=0)
            values[index[down, across], : rows - down, : columns - across] += both
            if down and across:
                values[index[down, -across], : rows - down, across:] += both


def stored_stencil(
    matrix: sparse.csc_array, weights: FloatArray, prior: float, frame: NDArray[np.intp], reach: int
) -> Stencil:
    """Return K of a window for any H, (M, N), that couples pixels up to `reach` apart.

    frame : (rows, columns) numbers of the window's pixels
    """
    part = sparse.csr_array(matrix[:, frame.ravel()])
    information = sparse.coo_array(part.T @ sparse.csr_array(part.multiply(weights[:, None])))
    row, column = np.divmod(information.row, frame.shape[1])
    other_row, other_column = np.divmod(information.col, frame.shape[1])
    numbers = np.full((2 * reach + 1, 2 * reach + 1), -1)
    for number, (down, across) in enumerate(half_offsets(reach)):
        numbers[down + reach, across + reach] = number
    number = numbers[other_row - row + reach, other_column - column + reach]
    half = number >= 0
    values = np.zeros((len(half_offsets(reach)), *frame.shape))
    values[number[half], row[half], column[half]] = information.data[half]
    values[0] += prior
    return Stencil(values, reach)


def pixel_numbers(shape: tuple[int, int], rows: slice, columns: slice) -> NDArray[np.intp]:
    """Return the numbers of the pixels of a window of a frame of `shape`: (rows, columns)."""
    down = np.asarray(range(rows.start, rows.stop), dtype=np.intp)
    across = np.asarray(range(columns.start, columns.stop), dtype=np.intp)
    return down[:, None] * shape[1] + across


def inverse_diagonal(count: int, block: Callable[[int, int], FloatArray]) -> FloatArray:
    """Return the diagonal of the inverse of `count` x `count` blocks; `block` gives the diagonal and upper blocks.

    Of a diagonal block only the upper triangle is read. Raises LinAlgError if the matrix is not positive definite.
    """
    inverses: list[FloatArray] = []
    links: list[FloatArray] = []
    for index in range(count):
        diagonal = block(index, index)
        if index:
            link = block(index - 1, index)
            links.append(inverses[-1] @ link)
            diagonal = diagonal - link.T @ links[-1]
        inverses.append(_inverse(diagonal))
    covariance = inverses[-1]
    variances = [np.diagonal(covariance)]
    for index in range(count - 2, -1, -1):
        covariance = inverses[index] + links[index] @ covariance @ links[index].T
        variances.append(np.diagonal(covariance))
    return np.concatenate(variances[::-1])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a positive definite matrix from its upper triangle."""
    factor, failed = linalg.lapack.dpotrf(matrix.T, lower=1, clean=0)  # the transpose is in Fortran's order
    inverse, singular = linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
    if failed or singular:
        raise linalg.LinAlgError("the precision of a part of the frame is singular in float64")
    lower = np.tril(inverse, -1)
    return lower + lower.T + np.diag(np.diagonal(inverse))


def stencil_variances(stencil: Stencil) -> FloatArray:
    """Return the diagonal of the inverse of K of a rectangle, (rows, columns), by blocks of `reach` of its rows."""
    rows, columns = stencil.values.shape[1:]
    high = max(stencil.reach, 1)
    blocks = _StencilBlocks(stencil, high)
    diagonal = inverse_diagonal(-(-rows // high), blocks)
    return diagonal[: rows * columns].reshape(rows, columns)


class _StencilBlocks:
    """Dense blocks of K: `high` lines of a rectangle each; lines beyond the last are independent of all others."""

    def __init__(self, stencil: Stencil, high: int) -> None:
        self.values, self.high = stencil.values, high
        self.columns = stencil.values.shape[2]
        self.places = self._places(stencil.reach)

    def __call__(self, row: int, column: int) -> FloatArray:
        """Return the diagonal block (upper triangle) or the block right of it: (high columns, high columns)."""
        side = self.high * self.columns
        source, target = self.places[column - row]
        part = self.values[:, row * self.high : (row + 1) * self.high]
        missing = self.high - part.shape[1]
        if missing:
            part = np.pad(part, ((0, 0), (0, missing), (0, 0)))
            part[0, -missing:] = 1.0
        block = np.zeros(side * side)
        block[target] = part.ravel()[source]
        return block.reshape(side, side)

    def _places(self, reach: int) -> tuple[tuple[Places, Places], tuple[Places, Places]]:
        """Return, for both kinds of block, the places of entries in the stencil's lines and in the block."""
        high, columns = self.high, self.columns
        sources: tuple[list[Places], list[Places]] = [], []
        targets: tuple[list[Places], list[Places]] = [], []
        for number, (down, across) in enumerate(half_offsets(reach)):
            begin = np.asarray(range(max(0, -across), min(columns, columns - across)), dtype=np.intp)
            for line in range(high):
                kind, other = divmod(line + down, high)
                sources[kind].append((number * high + line) * columns + begin)
                targets[kind].append((line * columns + begin) * high * columns + other * columns + begin + across)
        first, second = ((np.concatenate(a), np.concatenate(b)) for a, b in zip(sources, targets, strict=True))
        return first, second


def whole_variances(precision: sparse.csr_array, shape: tuple[int, int], reach: int) -> FloatArray:
    """Return the diagonal of K^-1 for the pixels of a frame, (rows, columns), from one sweep over all of it.

    reach : largest distance, in rows and in columns, of pixels that K couples
    Use it where errors are correlated over any distance.
    """
    numbers: NDArray[np.intp] = np.arange(shape[0] * shape[1]).reshape(shape)
    upright = shape[1] <= shape[0]
    ordered = numbers if upright else numbers.T
    blocks = [ordered[first : first + max(reach, 1)].ravel() for first in range(0, ordered.shape[0], max(reach, 1))]
    with one_thread():
        variances = inverse_diagonal(
            len(blocks), lambda row, column: precision[blocks[row]][:, blocks[column]].toarray()
        ).reshape(ordered.shape)
    return variances if upright else variances.T


@dataclass(frozen=True)
class EvenNoise:
    """K of a pixel far from the edges where noise is even, (offsets,) as in a stencil, and its posterior variance."""

    couplings: FloatArray
    variance: float


def frame_variances(source: Source, shape: tuple[int, int], halo: int, even: EvenNoise | None = None) -> FloatArray:
    """Return the diagonal of K^-1 for the pixels of a frame: (rows, columns).

    source : K of any window;  halo : pixels around the core of a window
    even : of similar noise, to correct what the halo leaves out; None where that is nothing
    Windows are computed in parallel, each by one thread.
    """
    margin = halo + BESIDE
    with one_thread():
        if min(shape) <= 2 * (margin + halo):
            return _strip_variances(source, slice(0, shape[0]), slice(0, shape[1]))
        variance = np.zeros(shape)
        size = min(LENGTH, shape[0] - 2 * margin), min(CORE, shape[1] - 2 * margin)
        correction = 1.0 if even is None else _correction(even, size, halo)
        lefts = _starts(margin, shape[1] - margin, size[1])
        with ThreadPoolExecutor(processors()) as threads:
            for top in _starts(margin, shape[0] - margin, size[0]):
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
