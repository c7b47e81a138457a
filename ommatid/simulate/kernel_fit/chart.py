"""Entries of H of the sensor pixels of a chart, in coordinates relative to their footprints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.runtime.memory import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernels import KernelPlaces
from ommatid.scenes.lens_type import LensType

from ..calibration.point_sources import Responses

LEAST_RAYS = 20.0  # in a cell, of all pixels: the fewest that its weight assumes, since few rays are not Gaussian
LEAST_SCATTER = 1e-3  # of independent rays' variance: the least that a weight assumes


@dataclass(frozen=True, eq=False)
class Chart:
    """Rows of H of n sensor pixels of a lens type, each of C = W^2 cells of the kernels.

    pixels : (n,) among those of the type;  values : (n, C), 0 beside the target
    inside : (n, C), True for cells on the target;  batches : (B, n, C) deviations of the batches from `values`
    rays : per pixel
    """

    places: KernelPlaces
    pixels: IntArray
    values: FloatArray
    inside: BoolArray
    batches: Float32Array
    rays: int

    @cached_property
    def field(self) -> FloatArray:
        """Positions (u, v) of the footprints: (n, 2)."""
        return self.places.positions(self.pixels)

    @cached_property
    def sub_imagers(self) -> IntArray:
        """The sub-imager of each pixel, numbered within the type: (n,)."""
        rows, columns = self.places.lens_type.pixels
        return self.pixels // (rows * columns)

    @cached_property
    def share(self) -> FloatArray:
        """Share of the pixels that see each cell: (C,)."""
        return self.inside.mean(axis=0)

    @cached_property
    def weights(self) -> FloatArray:
        """Inverse variances of a cell of one row, pooled over all rows: (C,), 0 for cells that no row has."""
        seen = self.inside.sum(axis=0)
        count = len(self.batches)
        squares = np.zeros(seen.size)
        for batch in self.batches:
            squares += np.square(batch, dtype=np.float64).sum(axis=0)
        variance = squares / (count * (count - 1)) / np.maximum(seen, 1)
        rate = (np.maximum(self.values.sum(axis=0) * self.rays, 0.0) + LEAST_RAYS) / np.maximum(seen * self.rays, 1)
        single = LEAST_RAYS / np.maximum(seen * self.rays, 1) / self.rays
        floor = np.maximum(single, LEAST_SCATTER * rate / self.rays)
        return np.where(seen > 0, 1 / np.maximum(variance, floor), 0.0)


def chart_of(responses: Responses, camera: Camera, lens_type: LensType, pixels: IntArray | None = None) -> Chart | None:
    """Return the chart of a lens type, or None if one of its pixels is dark.

    pixels : of the type, that the chart holds; None: those with light
    """
    matrix = responses.matrix[camera.type_slices()[camera.types.index(lens_type)]]
    counts = np.diff(matrix.indptr)
    pixels = np.flatnonzero(counts) if pixels is None else pixels
    if not pixels.size or not counts[pixels].all():
        return None
    places = KernelPlaces(camera, lens_type, _margin(camera, lens_type, matrix))
    size = places.width**2
    needed = pixels.size * size * (8 + 4 * len(responses.batches) + 1)
    check_memory(2 * needed, f"the kernels of lens type {lens_type.name}", "calibrate with calibration.fit = 'none'")
    cell = _cells(places, matrix)
    index = np.full(counts.size, -1)
    index[pixels] = np.arange(pixels.size)
    row = index[np.repeat(np.arange(counts.size), counts)]
    first = responses.matrix.indptr[camera.type_slices()[camera.types.index(lens_type)].start]
    stored = slice(int(first), int(first) + matrix.nnz)
    values = np.zeros((pixels.size, size))
    batches = np.zeros((len(responses.batches), pixels.size, size), dtype=np.float32)
    values[row, cell] = matrix.data
    for batch, entries in zip(batches, responses.batches[:, stored], strict=True):
        batch[row, cell] = entries
    down, across = (
        (cells >= 0) & (cells < size) for cells, size in zip(places.cells(pixels), camera.shape, strict=True)
    )
    inside = (down[:, :, None] & across[:, None]).reshape(pixels.size, size)
    return Chart(places, pixels, values, inside, batches, responses.passes * responses.samples)


def _offsets(places: KernelPlaces, matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Return row and column of each entry, from the corner of its pixel's kernel: (nnz,) each."""
    pixel = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    row, column = places.lines(pixel)
    down, across = np.divmod(matrix.indices.astype(np.int64), places.camera.columns)
    return down - places.starts[0][row], across - places.starts[1][column]


def _cells(places: KernelPlaces, matrix: sparse.csr_array) -> IntArray:
    down, across = _offsets(places, matrix)
    return down * places.width + across


def _margin(camera: Camera, lens_type: LensType, matrix: sparse.csr_array) -> int:
    """Return the pixels of f beyond a footprint that light reaches on any side."""
    last = int(lens_type.ratio) - 1
    offsets = _offsets(KernelPlaces(camera, lens_type, 0), matrix)
    return max(max(-int(offset.min()), int(offset.max()) - last, 0) for offset in offsets)
