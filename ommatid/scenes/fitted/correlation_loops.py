"""Correlations of an image with kernels that vary over the field, compiled.

Work is divided into ranges of rows that do not depend on the number of threads, so neither do the results.
"""

# pyright: basic
from __future__ import annotations

import numpy as np

from ommatid.runtime.library_caches import compiled

UNROLLED = 4


@compiled
def correlate_line(image, kernels, top, left, length, source, lines):
    """Fill `lines`, (S, length), with sums of kernels * image at row `top` and columns left, left + 1, ... of f.

    Pixels beside the image are 0.  source : buffer of length + W
    """
    rows, columns = image.shape
    count, tall, wide = kernels.shape
    lines[:] = 0.0
    begin, end = max(left, 0), min(left + source.size, columns)
    for dy in range(tall):
        y = top + dy
        if y < 0 or y >= rows:
            continue
        source[:] = 0.0
        source[begin - left : end - left] = image[y, begin:end]
        for s in range(count):
            line = lines[s]
            for dx in range(0, wide - wide % UNROLLED, UNROLLED):
                a, b, c, d = kernels[s, dy, dx], kernels[s, dy, dx + 1], kernels[s, dy, dx + 2], kernels[s, dy, dx + 3]
                for x in range(length):
                    line[x] += (a * source[x + dx] + b * source[x + dx + 1]) + (
                        c * source[x + dx + 2] + d * source[x + dx + 3]
                    )
            for dx in range(wide - wide % UNROLLED, wide):
                a = kernels[s, dy, dx]
                for x in range(length):
                    line[x] += a * source[x + dx]


@compiled
def correlate(image, kernels, weights, down, across, order, top, left, columns_at, out, first, last):
    """Fill `out`, (K, L, rows, columns), for sensor rows order[first:last].

    weights : (S, P, P) of products of polynomials down and across, (sensor rows, P) and (sensor columns, P)
    top, left : first row and column of f of each sensor row and of all columns;  columns_at : (sensor columns,) - left
    """
    count, powers = weights.shape[0], weights.shape[1]
    length, wide = columns_at.max() + 1, kernels.shape[2]
    lines, source = np.empty((count, length)), np.empty(length + wide - 1)
    factors = np.empty((count, powers))
    before = -(1 << 60)
    for position in range(first, last):
        row = order[position]
        if top[row] != before:
            before = top[row]
            correlate_line(image, kernels, before, left, length, source, lines)
        _factors(weights, down[row], factors)
        k, i = row // out.shape[2], row % out.shape[2]
        for column in range(columns_at.size):
            total, x = 0.0, columns_at[column]
            for s in range(count):
                share = 0.0
                for b in range(powers):
                    share += factors[s, b] * across[column, b]
                total += share * lines[s, x]
            out[k, column // out.shape[3], i, column % out.shape[3]] = total


@compiled
def _factors(weights, down, factors):
    """Fill `factors`, (S, P), with the weights of the polynomials across at one sensor row."""
    for s in range(weights.shape[0]):
        for b in range(weights.shape[2]):
            total = 0.0
            for a in range(weights.shape[1]):
                total += weights[s, a, b] * down[a]
            factors[s, b] = total
