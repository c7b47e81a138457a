"""The precision of a frame as a stencil: for every pixel its couplings to the pixels nearby.

K = H^T W H + p I is symmetric and couples only pixels that one sensor pixel sees. A stencil holds the couplings of each
pixel (r, c) to (r + i, c + j) for offsets with i > 0, or i = 0 and j >= 0; the others follow by symmetry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType


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
