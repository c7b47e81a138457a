"""What the design leaves of the rows of H of a chart's sensor pixels, in the cells in which kernels are learnt.

Rows are taken in coordinates relative to the footprints of their pixels. Around a core, which holds most of the light,
the design gives the shape of the light, and only its amount in square rings is measured: diffraction reaches far, and a
cell there is met by few rays. Light beyond the design's kernels, of which rays have none, is cut off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import Float32Array, FloatArray, IntArray
from ommatid.runtime.machine import check_memory
from ommatid.scenes.fitted.kernel_shapes import KernelShapes, ring_masks
from ommatid.scenes.fitted.kernels import KernelFootprints, KernelPlaces

from ..calibration.responses import Responses

LEAST_RAYS = 20.0  # in a cell, of all pixels: the fewest that its weight assumes, since few rays are not Gaussian
LEAST_SCATTER = 1e-3  # of independent rays' variance: the least that a weight assumes
CORE = 0.01  # of the largest light in a cell: cells with more are learnt one by one,
LEAST_INSIDE = 0.5  # of a ring's light that is on the target, from which a pixel tells of it
MOST_CORE = 48  # pixels of f along an axis: in a core of at most so many
VALUES_AT_ONCE = 2**24  # of kernels that are made for a part of the pixels
LEVEL = 3.0  # mean squared over variance of a picture whose values are uniform between 0 and 255
CORRELATED = 3.0  # pixels of f over which a picture's correlation falls to 1/e


@dataclass(frozen=True, eq=False)
class Chart:
    """Deviations from the design of n sensor pixels of a lens type in C = w^2 + B cells, those of the rings last.

    designed : H of the design;  core : w;  pixels : (n,) among those of the type
    values : (n, C), 0 beside the target;  batches : (B, n, C) deviations of the batches from these
    inside : (n, C) share of a cell's light that is on the target, 0 or 1 in the core
    light : (C,) of all pixels together;  rays : per pixel
    """

    designed: KernelFootprints
    core: int
    pixels: IntArray
    values: FloatArray
    inside: FloatArray
    batches: Float32Array
    light: FloatArray
    rays: int

    @property
    def places(self) -> KernelPlaces:
        """Where the kernels lie."""
        return self.designed.places

    @property
    def is_square(self) -> bool:
        """True if sensor pixels are open by squares."""
        return len(set(self.places.lens_type.open)) == 1

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
        rate = (np.maximum(self.light * self.rays, 0.0) + LEAST_RAYS) / np.maximum(seen * self.rays, 1)
        single = LEAST_RAYS / np.maximum(seen * self.rays, 1) / self.rays
        floor = np.maximum(single, LEAST_SCATTER * rate / self.rays)
        return np.where(seen > 0, 1 / np.maximum(variance, floor), 0.0)

    def seen(self, errors: FloatArray) -> FloatArray:
        """Return errors of kernels, (..., C), in coordinates whose squares add up to the variance of H f: (..., C + 1).

        The picture has a variance of 1, and a correlation that falls exponentially down and across; rings count as if
        they were not correlated.
        """
        core, rings = np.split(errors, [self.core**2], axis=-1)
        values, vectors = np.linalg.eigh(_correlation(self.core))
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        varied = root @ core.reshape(*core.shape[:-1], self.core, self.core) @ root
        level = LEVEL**0.5 * errors.sum(axis=-1, keepdims=True)
        return np.concatenate([varied.reshape(core.shape), rings * self._ring_deviations, level], axis=-1)

    @cached_property
    def _ring_deviations(self) -> FloatArray:
        """Deviation of the picture's mean over each ring, by the design's light: (B,)."""
        correlation = _correlation(self.places.width)
        found: list[float] = []
        for mask in ring_masks(self.places.width, self.core):
            ring = np.where(mask, self.designed.shapes.designed[0], 0.0)
            ring /= ring.sum() or 1.0
            found.append(float(np.sum(ring * (correlation @ ring @ correlation))) ** 0.5)
        return np.array(found)


def _correlation(size: int) -> FloatArray:
    place = np.arange(size, dtype=np.float64)
    return np.exp(-np.abs(place[:, None] - place) / CORRELATED)


def chart_of(responses: Responses, designed: KernelFootprints, pixels: IntArray | None = None) -> Chart | None:
    """Return the chart of a lens type, or None if one of its pixels is dark.

    designed : H of the design;  pixels : of the type, that the chart holds; None: those with light
    """
    camera, lens_type = designed.places.camera, designed.places.lens_type
    type_rows = camera.type_slices()[camera.types.index(lens_type)]
    matrix = responses.matrix[type_rows]
    counts = np.diff(matrix.indptr)
    pixels = np.flatnonzero(counts) if pixels is None else pixels
    if not pixels.size or not counts[pixels].all():
        return None
    margin = max(designed.places.margin, _margin(designed.places, matrix))
    places = replace(designed.places, margin=margin)
    cell, wide = _cells(places, matrix), places.width
    beside = margin - designed.places.margin
    down, across = (np.pad(each, ((beside, beside), (0, 0))) for each in (designed.shapes.down, designed.shapes.across))
    measured = np.bincount(cell, weights=matrix.data, minlength=wide**2).reshape(wide, wide) / pixels.size
    mean = np.pad(designed.shapes.designed[0], beside)
    core = _core(np.maximum(measured, mean))
    masks = ring_masks(wide, core)
    none = np.zeros((0, core, core)), np.zeros((0, len(masks)))
    designed = replace(
        designed, places=places, shapes=KernelShapes(down, across, designed.shapes.products, *none, *none)
    )
    size = core**2 + len(masks)
    needed = pixels.size * size * (8 + 8 + 4 * len(responses.batches))
    check_memory(2 * needed, f"the kernels of lens type {lens_type.name}", "calibrate with calibration.fit = 'none'")
    index = np.full(counts.size, -1)
    index[pixels] = np.arange(pixels.size)
    row = index[np.repeat(np.arange(counts.size), counts)]
    where = row * size + _numbers(wide, core)[cell]
    first = int(responses.matrix.indptr[type_rows.start])

    def summed(entries: FloatArray | Float32Array) -> FloatArray:
        total = np.bincount(where, weights=entries, minlength=pixels.size * size)
        return np.asarray(total, dtype=np.float64).reshape(pixels.size, size)

    values = summed(matrix.data)
    batches = np.array([summed(each[first : first + matrix.nnz]) for each in responses.batches], dtype=np.float32)
    expected, inside = _expected(designed, core, pixels)
    beside = inside < LEAST_INSIDE
    for each in (values, expected, inside, *batches):
        each[beside] = 0.0
    rays, light = responses.passes * responses.samples, values.sum(axis=0)
    return Chart(designed, core, pixels, values - expected, inside, batches, light, rays)


def _expected(designed: KernelFootprints, core: int, pixels: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the design's light on the target in each cell, and its share of all light there: (n, C) each."""
    places, shape = designed.places, designed.shape
    wide, mean, masks = places.width, designed.shapes.designed[0], ring_masks(places.width, core)
    middle = slice((wide - core) // 2, (wide + core) // 2)
    expected, shares = list[FloatArray](), list[FloatArray]()
    step = 1 + VALUES_AT_ONCE // (wide * wide)
    for part in (pixels[first : first + step] for first in range(0, pixels.size, step)):
        down, across = ((cells >= 0) & (cells < size) for cells, size in zip(places.cells(part), shape, strict=True))
        inside = down[:, :, None] & across[:, None]
        values = np.where(inside, designed.values(part), 0.0)
        rings = [values[:, mask].sum(axis=1) for mask in masks]
        lit = [inside[:, mask] @ mean[mask] / (mean[mask].sum() or 1.0) for mask in masks]
        for found, cells, sums in ((expected, values, rings), (shares, inside, lit)):
            flat = cells[:, middle, middle].reshape(part.size, -1)
            found.append(np.column_stack([flat.astype(np.float64), *sums]))
    return np.concatenate(expected), np.concatenate(shares)


def _core(light: FloatArray) -> int:
    """Return the width of the square in the middle, of W x W, that holds all cells with much light."""
    wide = len(light)
    offset = np.abs(2 * np.arange(wide) + 1 - wide)
    lit = light > CORE * light.max()
    width = int(np.maximum.outer(offset, offset)[lit].max()) + 1
    return min(width, MOST_CORE - (wide - MOST_CORE) % 2)


def _numbers(wide: int, core: int) -> IntArray:
    """Return the number among C of each of W x W cells: (W^2,)."""
    numbers = np.zeros((wide, wide), dtype=np.int64)
    middle = slice((wide - core) // 2, (wide + core) // 2)
    numbers[middle, middle] = np.arange(core**2).reshape(core, core)
    for number, mask in enumerate(ring_masks(wide, core)):
        numbers[mask] = core**2 + number
    return numbers.ravel()


def _offsets(places: KernelPlaces, matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Return row and column of each entry, from the corner of its pixel's kernel: (nnz,) each."""
    pixel = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    row, column = places.lines(pixel)
    down, across = np.divmod(matrix.indices.astype(np.int64), places.camera.columns)
    return down - places.starts[0][row], across - places.starts[1][column]


def _cells(places: KernelPlaces, matrix: sparse.csr_array) -> IntArray:
    down, across = _offsets(places, matrix)
    return down * places.width + across


def _margin(places: KernelPlaces, matrix: sparse.csr_array) -> int:
    """Return the pixels of f beyond a footprint that light reaches on any side."""
    last = int(places.lens_type.ratio) - 1
    offsets = _offsets(replace(places, margin=0), matrix)
    return max(max(-int(offset.min()), int(offset.max()) - last, 0) for offset in offsets)
