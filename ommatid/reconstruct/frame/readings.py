"""What a lens type reads of a world: readings one pixel of f apart, by kernels of the world's pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import ceil, floor

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

LEAST_PART = 1e-3  # of the power of the strongest kernel of boxes that begin at fractions of a pixel


@dataclass(frozen=True)
class Readings:
    """Readings one pixel of f apart, along both axes, by a kernel of the world's pixels, or by several.

    Where readings begin at fractions of a pixel, no one kernel is theirs: the mean of K's terms over these fractions is
    that of several kernels, each even or odd along either axis.

    kernels : (parts, rows, columns);  first : row and column of the world where those of the first reading begin
    count : readings down and across
    """

    kernels: FloatArray
    first: tuple[int, int]
    count: tuple[int, int]

    @property
    def extent(self) -> tuple[int, int]:
        """Rows and columns of a kernel."""
        return self.kernels.shape[1], self.kernels.shape[2]

    def is_odd(self, axis: int, detail: int) -> bool:
        """Return True if the middles of readings are those of pixels of f, False if they are edges between these."""
        return round((2 * self.first[axis] + self.extent[axis]) / detail) % 2 == 1

    def matrix(self, shape: tuple[int, int], detail: int) -> sparse.csr_array:
        """Return the readings as a matrix on a world of this shape: (parts times readings, its pixels)."""
        places: list[IntArray] = [
            (first + detail * np.arange(count))[:, None] + np.arange(length)
            for first, count, length in zip(self.first, self.count, self.extent, strict=True)
        ]
        down, across = places[0][:, None, :, None], places[1][None, :, None, :]
        inside = (down >= 0) & (down < shape[0]) & (across >= 0) & (across < shape[1])
        inside = inside & (self.kernels != 0)[:, None, None]
        pixels = np.broadcast_to(down * shape[1] + across, inside.shape)[inside]
        values = np.broadcast_to(self.kernels[:, None, None], inside.shape)[inside]
        pointers = np.concatenate([[0], np.cumsum(inside.sum(axis=(3, 4)).ravel())])
        size = len(self.kernels) * self.count[0] * self.count[1], shape[0] * shape[1]
        return sparse.csr_array((values, pixels, pointers), shape=size)

    def shortened(self, by: tuple[int, int]) -> Readings:
        """Return the readings of an image of fewer rows and columns of f with the same edges."""
        rows, columns = (max(count - less, 1) for count, less in zip(self.count, by, strict=True))
        return replace(self, count=(rows, columns))


def by_kernel(lens_type: LensType, kernel: FloatArray, detail: int) -> Readings:
    """Return the readings by a kernel, and its mirror images, one pixel of f apart in the field of a lens type."""
    first, count = list[int](), list[int]()
    for (start, end), length in zip(lens_type.bounds, kernel.shape, strict=True):
        first.append(round(float(start) + (float(lens_type.ratio) - length) / 2))
        count.append(max(round((float(end - start) - float(lens_type.ratio)) / detail) + 1, 1))
    upright = kernel + kernel[::-1]
    return Readings((upright + upright[:, ::-1])[None] / 4, (first[0], first[1]), (count[0], count[1]))


def box(lens_type: LensType) -> FloatArray:
    """Return the reading by a box in the middle of a pixel's footprint: (rows, columns) of the pixel's whole width."""
    middles = np.arange(ceil(lens_type.ratio) + 1.0) - ceil(lens_type.ratio) / 2
    sides = [float(side) for side in lens_type.footprint]
    down, across = (np.diff(np.clip(middles, -side / 2, side / 2)) / side for side in sides)
    return np.outer(float(lens_type.light) * down, across)


def boxes(lens_type: LensType) -> Readings:
    """Return the readings by boxes one pixel of f apart, by kernels of their mean power where places are fractions."""
    ratio, axes = lens_type.ratio, list[FloatArray]()
    first, count = list[int](), list[int]()
    for axis, (start, end) in enumerate(lens_type.bounds):
        inset = lens_type.inset[axis]
        first.append(floor(start + inset))
        count.append(max(floor(end + inset - ratio - first[axis]) + 1, 1))
        views = product(lens_type.starts(axis), range(lens_type.pixels[axis]))
        places = [float((view + inset + ratio * n) % 1) for view, n in views]
        axes.append(_mean_power(float(lens_type.footprint[axis]), places))
    kernels = float(lens_type.light) * np.einsum("ax,by->abxy", *axes)
    kernels = kernels.reshape(-1, axes[0].shape[1], axes[1].shape[1])
    power = np.square(kernels).sum(axis=(1, 2))
    return Readings(kernels[power > LEAST_PART * power.max()], (first[0], first[1]), (count[0], count[1]))


def _mean_power(side: float, starts: list[float]) -> FloatArray:
    """Return even and odd lines, the sum of whose powers is the mean of that of boxes: (lines, pixels)."""
    places, counts = np.unique(np.round(starts, 9), return_counts=True)
    edges = np.arange(ceil(float(places.max()) + side) + 1.0)
    shares: FloatArray = np.diff(np.minimum(np.maximum(edges - places[:, None], 0.0), side)) / side
    shares *= np.sqrt(counts / counts.sum())[:, None]
    parts = [np.linalg.svd((shares + sign * shares[:, ::-1]) / 2, full_matrices=False) for sign in (1, -1)]
    return np.concatenate([values[:, None] * vectors for _, values, vectors in parts])


def leaves_null_space(camera: Camera) -> bool:
    """Return True unless three lens types with footprints of pairwise coprime whole sides, m x m each, see the frame.

    Two of them leave 2 (m - 1) (n - 1) dimensions and more (docs/paper.md), and errors that reach far.
    """
    squares = {down for down, across in (lens_type.footprint for lens_type in camera.types) if down == across}
    whole = sorted(int(side) for side in squares if side.denominator == 1)
    return (
        not any(
            np.gcd(a, b) == np.gcd(a, c) == np.gcd(b, c) == 1
            for i, a in enumerate(whole)
            for j, b in enumerate(whole[i + 1 :], i + 1)
            for c in whole[j + 1 :]
        )
        and 1 not in whole
    )
