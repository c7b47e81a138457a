"""Averages over boxes and their adjoint, compiled; each reads and writes memory once.

Work is divided into ranges of rows that do not depend on the number of threads, so neither do the results.
"""

# pyright: basic
from __future__ import annotations

import numpy as np

from ommatid.runtime.library_caches import compiled


@compiled
def average(image, order, row_start, row_share, column_start, column_share, out, first, last):
    """Fill `out` with averages of `image` over boxes, for sensor rows order[first:last]; see `boxes.BoxAxis`."""
    columns = image.shape[1]
    across, pixels = out.shape[1], out.shape[3]
    line = np.empty(columns)
    for position in range(first, last):
        row = order[position]
        line[:] = 0.0
        for q in range(row_share.shape[1]):
            share = row_share[row, q]
            if share != 0.0:
                source = image[row_start[row] + q]
                for x in range(columns):
                    line[x] += share * source[x]
        k, i = row // out.shape[2], row % out.shape[2]
        for l in range(across):  # noqa: E741
            for j in range(pixels):
                column = l * pixels + j
                start, total = column_start[column], 0.0
                for q in range(column_share.shape[1]):
                    total += column_share[column, q] * line[start + q]
                out[k, l, i, j] = total


@compiled
def spread(readings, order, row_start, row_share, column_start, column_share, out, first, last):
    """Add the adjoint of `average`, applied to `readings`, to rows first to last of `out`."""
    columns = out.shape[1]
    across, pixels = readings.shape[1], readings.shape[3]
    wide = row_share.shape[1]
    line = np.empty(columns)
    for row in order:
        start = row_start[row]
        if start + wide <= first or start >= last:
            continue
        k, i = row // readings.shape[2], row % readings.shape[2]
        line[:] = 0.0
        for l in range(across):  # noqa: E741
            for j in range(pixels):
                column = l * pixels + j
                begin, value = column_start[column], readings[k, l, i, j]
                for q in range(column_share.shape[1]):
                    line[begin + q] += column_share[column, q] * value
        for q in range(wide):
            share = row_share[row, q]
            if share != 0.0 and first <= start + q < last:
                target = out[start + q]
                for x in range(columns):
                    target[x] += share * line[x]
