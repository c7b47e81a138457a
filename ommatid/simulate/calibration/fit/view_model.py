"""Rows of H that the numbers of a view predict, in the windows of a chart."""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.view import K1, MAGNIFICATION, ROTATION, designed, displacements, entries, offsets
from ommatid.scenes.lens_type import SubImager

from .chart import ChartRows

STRAIGHT = 1e-4  # rad, and relative of k1: below, footprints are boxes to within 0.1 ray of 1024


def predicted(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> FloatArray:
    """Return the rows of H of the chart's pixels by the numbers of the view: (pixels, W, V)."""
    return (_boxes if has_boxes(sub, numbers) else _exact)(camera, sub, numbers, chart)


def has_boxes(sub: SubImager, numbers: FloatArray) -> bool:
    """Return True if all footprints of a view are boxes, or nearly so."""
    straight = abs(numbers[ROTATION]) <= STRAIGHT and abs(numbers[K1]) <= STRAIGHT
    return straight and not sub.rotation and sub.type.optics.distortion is None


def _boxes(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> FloatArray:
    """Take every footprint for a box, displaced as its middle is by rotation and distortion."""
    down, across = offsets(sub, (chart.down, chart.across))
    moved = (numbers - designed(sub)) * (np.arange(numbers.size) != MAGNIFICATION)
    rows, columns = (each @ moved for each in displacements(camera, sub, (chart.down, chart.across)))
    growth = 1 + float(numbers[MAGNIFICATION])
    middle, width = sub.type.middle(sub.window), float(sub.type.ratio) / growth
    shares = [
        _overlap(centre + offset / growth + move - width / 2, width, first, size)
        for centre, offset, move, first, size in zip(
            middle, (down, across), (rows, columns), (chart.row, chart.column), chart.values.shape[1:], strict=True
        )
    ]
    return shares[0][:, :, None] * shares[1][:, None, :]


def _overlap(start: FloatArray, width: float, first: IntArray, size: int) -> FloatArray:
    """Return the shares of `size` cells from `first` on in intervals from `start` on: (pixels, size)."""
    cells = first[:, None] + np.arange(size)
    shared = np.minimum(start[:, None] + width, cells + 1.0) - np.maximum(start[:, None], cells)
    return np.maximum(shared, 0.0) / width


def _exact(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> FloatArray:
    """Take the exact areas of overlap."""
    pixels = (chart.down * sub.type.pixels[1] + chart.across).astype(np.int64)
    rows = entries(camera, sub, numbers)[pixels]
    cells = np.repeat(np.arange(pixels.size), np.diff(rows.indptr))
    row, column = np.divmod(rows.indices.astype(np.int64), camera.columns)
    row, column = row - chart.row[cells], column - chart.column[cells]
    values = np.zeros_like(chart.values)
    inside = (row >= 0) & (row < values.shape[1]) & (column >= 0) & (column < values.shape[2])
    values[cells[inside], row[inside], column[inside]] = rows.data[inside]
    return values
