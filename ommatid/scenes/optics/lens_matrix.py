"""H of blurred lens types: the point-spread functions of waves, integrated over sensor pixels and pixels of f.

Lengths are pixels of f. An entry is the mean of overlap(y, dy) overlap(x, dx) over the displacements (dx, dy) of the
point-spread function, where overlap is the share of the footprint [a, b] + d along an axis that lies in the texel. The
footprint is the box between the middles of the light of the pixel's edges, so that distortion is part of it. An
overlap is the second difference B(b - c) - B(b - d) + B(a - d) - B(a - c) of B(t) = |t| / 2. On a grid of cells D wide
the point-spread function holds no frequency above 1 / 2D; the sum over the grid is exact where B is freed of these too,

    B(t) = (t Si(W t) + cos(W t) / W) / pi,   W = pi / D,   Si the sine integral (Shannon's sampling theorem).

The blur of pixels convolves all with a Gaussian: for rays B(t) becomes t (Phi(t / s) - 1/2) + s phi(t / s), and waves'
point-spread functions are convolved on their grid. Its deviation is in proportion to the footprint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from math import ceil, pi

import numpy as np
from scipy import fft, ndimage, sparse
from scipy.special import ndtr, sici

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import check_memory

from ..camera import Camera
from ..constants import DEVIATIONS
from ..lens_type import LensType
from ..pose import pixel_middles, pose_of
from .field import Optics, bands, check_waves, optics_of
from .wavefront import Wavefront

SAME = 6  # digits of edges of footprints, which pixels of a row share
LEAST = 1e-12  # entries below are left out
ENTRY = 16  # bytes


@dataclass(frozen=True, eq=False)
class _PixelFootprints:
    """Sensor pixels of a lens type, in the order of measurements.

    x, y : (M,) middle, mm from the lens's axis;  rows, columns : (M, 2) edges of the footprint
    blur : standard deviation of the pixels' blur over the sides of their open part, down and across
    """

    x: FloatArray
    y: FloatArray
    rows: FloatArray
    columns: FloatArray
    blur: tuple[float, float]


@lru_cache(maxsize=4)
def matrix(camera: Camera, lens_type: LensType) -> sparse.csr_array:
    """H of all sub-imagers of a lens type, as designed, pixel by pixel: (its measurements, N).

    A row holds the light of a pixel that comes from the target: less than 1, as diffraction takes up to 0.5 per cent
    of the light beyond the grid of the point-spread function. Rows of pixels without light are empty. Neglected is the
    variation of the blur within a pixel.
    Raises InputError if the surfaces form no image, or aberrations of too many waves.
    """
    parts = (_band(camera, lens_type, wavelength, weight) for wavelength, weight in bands(camera))
    entries, total = next(parts)
    for more, light in parts:
        entries, total = sparse.csr_array(entries + more), total + light
    scale = np.divide(float(lens_type.light), total, out=np.zeros_like(total), where=total > 0)
    return sparse.csr_array(sparse.diags_array(scale) @ entries)


def _band(
    camera: Camera, lens_type: LensType, wavelength: float | None, weight: float
) -> tuple[sparse.csr_array, FloatArray]:
    """Return H at one wavelength times the light of each pixel, and this light, whose share in all is `weight`."""
    field = optics_of(camera, lens_type, wavelength)
    check_waves(lens_type, field)
    pixels = _pixels(camera, lens_type, field)
    light = weight * field.weight(np.hypot(pixels.x, pixels.y))
    return sparse.csr_array(sparse.diags_array(light) @ _rows(camera, field, pixels)), light


def _pixels(camera: Camera, lens_type: LensType, field: Optics) -> _PixelFootprints:
    parts: list[FloatArray] = []
    for sub in (sub for sub in camera.sub_imagers if sub.type == lens_type):
        x, y, _ = pixel_middles(camera, sub, pose_of(sub)).reshape(-1, 3).T
        down, across = edges_at(camera, field, lens_type, x, y)
        rows = camera.rows / 2 - sub.lens[1] / camera.target_pitch + down
        parts.append(np.stack([x, y, *rows.T, *(camera.columns / 2 - sub.lens[0] / camera.target_pitch + across).T]))
    x, y, *edges = np.concatenate(parts, axis=1)
    return _PixelFootprints(x, y, np.stack(edges[:2], axis=1), np.stack(edges[2:], axis=1), blur_of(camera, lens_type))


def edges_at(camera: Camera, field: Optics, lens_type: LensType, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the edges of the footprints of pixels at (x, y) from the lens's axis, in pixels of f: (2, ..., 2).

    Down first, and then across, from the point of the target on the axis.
    """
    tall, wide = (camera.pixel_pitch / 2 * float(part) for part in lens_type.open)
    down = np.stack([field.chief_ray(x, y + side)[1] for side in (-tall, tall)], axis=-1)
    across = np.stack([field.chief_ray(x + side, y)[0] for side in (-wide, wide)], axis=-1)
    return -np.stack([down, across]) / camera.target_pitch


def blur_of(camera: Camera, lens_type: LensType) -> tuple[float, float]:
    """Return the standard deviation of the blur of a type's pixels over the sides of their open part."""
    deviation = (lens_type.optics.pixel_blur or 0.0) / camera.pixel_pitch
    return deviation / float(lens_type.open[0]), deviation / float(lens_type.open[1])


def _rows(camera: Camera, field: Optics, pixels: _PixelFootprints) -> sparse.csr_array:
    count = pixels.x.size
    own = float(np.ptp(pixels.rows[0])) * (1 + 2 * DEVIATIONS * pixels.blur[0])
    side = [min(size, own + 2 * field.reach / camera.target_pitch + 2) for size in camera.shape]
    needed = int(count * side[0] * side[1]) * ENTRY
    check_memory(needed, "H of blurred pixels", "crop the target or use fewer sub-imagers")
    rows: list[sparse.csr_array] = [sparse.csr_array((1, camera.unknowns))] * count
    lit = np.flatnonzero(field.weight(np.hypot(pixels.x, pixels.y)) > 0)
    by_points = _by_rays if field.rays_suffice else _by_waves
    for pixel, values in by_points(camera, field, pixels, lit):
        values[values < LEAST] = 0.0
        rows[pixel] = sparse.csr_array(values.reshape(1, -1))
    return sparse.csr_array(sparse.vstack(rows, format="csr"))


def _by_rays(
    camera: Camera, field: Optics, pixels: _PixelFootprints, lit: IntArray
) -> Iterator[tuple[int, FloatArray]]:
    """Compute the entries, (rows, columns) of f, of each lit pixel from the rays of the nodes beside its height."""
    for pixel in lit.tolist():
        x, y = float(pixels.x[pixel]), float(pixels.y[pixel])
        values, edges = np.zeros(camera.shape), (pixels.rows[pixel], pixels.columns[pixel])
        for wave, share in field.between(float(np.hypot(x, y))):
            turned = wave.turned(float(np.arctan2(-x, y)))
            values += share * row_by_rays(turned, camera.target_pitch, edges, pixels.blur, camera.shape)
        yield pixel, values


def _by_waves(
    camera: Camera, field: Optics, pixels: _PixelFootprints, lit: IntArray
) -> Iterator[tuple[int, FloatArray]]:
    """Compute the entries, (rows, columns) of f, of each lit pixel; pixels with one point-spread function in turn."""
    cell, levels = field.grid[0] / camera.target_pitch, [max(steps, 1) for steps in field.steps]
    keys = {int(pixel): _key(field, float(pixels.x[pixel]), float(pixels.y[pixel])) for pixel in lit}
    spread_at, before = field.spreads(0.0), 0
    for (turn, level), members in groupby(sorted(keys, key=keys.__getitem__), key=keys.__getitem__):
        if turn != before:
            spread_at, before = field.spreads(pi / 2 * turn / levels[1]), turn
        spread = spread_at(field.field * level / levels[0])
        for pixel in members:
            x, y = pixels.x[pixel], pixels.y[pixel]
            turned = spread.T if abs(x) > abs(y) else spread
            turned = turned[:: -1 if y < 0 else 1, :: -1 if x < 0 else 1]
            edges = pixels.rows[pixel], pixels.columns[pixel]
            yield pixel, row_by_waves(turned, cell, edges, pixels.blur, camera.shape)


def _key(field: Optics, x: float, y: float) -> tuple[int, int]:
    """Return the level of direction, folded into the half quadrant beside the y axis, and of height, of a pixel."""
    levels, turns = field.steps
    angle = float(np.arctan2(min(abs(x), abs(y)), max(abs(x), abs(y))))
    return round(angle / (pi / 2) * turns), round(float(np.hypot(x, y)) / field.field * levels)


def overlaps(edges: FloatArray, offsets: FloatArray, size: int, cell: float) -> FloatArray:
    """Return the share of the interval between two edges, moved by each offset, in each texel: (n, size).

    cell : spacing of the offsets, whose frequencies are left out
    """
    rate = pi / cell

    def integral(t: FloatArray) -> FloatArray:
        return (t * sici(rate * t)[0] + np.cos(rate * t) / rate) / pi

    return _shares(edges, offsets[:, None] - np.arange(size + 1), integral)


def _shares(edges: FloatArray, offsets: FloatArray, integral: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the second differences of B, `integral`, over an interval and over the texels that offsets divide."""
    low, high = edges.min(), edges.max()
    upper, lower = integral(high + offsets), integral(low + offsets)
    return (upper[:, :-1] - upper[:, 1:] + lower[:, 1:] - lower[:, :-1]) / (high - low)


def ray_overlaps(edges: FloatArray, offsets: FloatArray, size: int, deviation: float) -> sparse.csr_array:
    """Return the share of the interval between two edges, moved by each offset, in each texel: (n, size).

    deviation : of a Gaussian by which it is moved in addition, or 0
    """
    low, high, beside = edges.min(), edges.max(), DEVIATIONS * deviation
    first: FloatArray = np.floor((low - beside + offsets).round(SAME))  # rounding decides nothing
    count = ceil(round(float(high - low + 2 * beside), SAME)) + 1
    cells = np.asarray(first[:, None] + np.arange(count), dtype=np.intp)

    def integral(t: FloatArray) -> FloatArray:
        if deviation == 0:
            return np.abs(t) / 2
        at = t / deviation
        return t * (ndtr(at) - 0.5) + deviation / np.sqrt(2 * pi) * np.exp(-np.square(at) / 2)

    beside_first: FloatArray = (offsets - first)[:, None] - np.arange(count + 1, dtype=np.float64)
    shares = _shares(edges, beside_first, integral)
    inside = (cells >= 0) & (cells < size)
    starts = np.concatenate([[0], np.cumsum(inside.sum(axis=1))])
    return sparse.csr_array((shares[inside], cells[inside], starts), shape=(offsets.size, size))


def row_by_rays(
    wave: Wavefront, pitch: float, edges: Sequence[FloatArray], blur: tuple[float, float], shape: tuple[int, int]
) -> FloatArray:
    """Return the entries, (rows, columns) of f, of a pixel whose light is rays. pitch : of f;  see `row_by_waves`."""
    down, beside = (
        ray_overlaps(each, -moved / pitch, size, part * float(np.ptp(each)))
        for each, moved, part, size in zip(edges, wave.hits[::-1], blur, shape, strict=True)
    )
    return np.asarray(((sparse.diags_array(wave.light) @ down).T @ beside).toarray(), dtype=np.float64)


@lru_cache(maxsize=256)
def _cell_overlaps(low: float, high: float, count: int, size: int, cell: float) -> FloatArray:
    """Return `overlaps` of the cells of a point-spread function, once for all pixels of a sensor row or column."""
    offsets = cell * (np.arange(count, dtype=np.float64) - count // 2)
    return overlaps(np.array([low, high]), -offsets, size, cell)


def row_by_waves(
    spread: FloatArray, cell: float, edges: Sequence[FloatArray], blur: tuple[float, float], shape: tuple[int, int]
) -> FloatArray:
    """Return the entries, (rows, columns) of f, of a pixel with a point-spread function, (n, n) cells.

    edges, blur : of its footprint, down and across, and its blur over these lengths;  shape : rows and columns
    """
    if any(blur):
        deviations = [part * float(np.ptp(each)) / cell for part, each in zip(blur, edges, strict=True)]
        moved = fft.fft2(np.pad(spread, ceil(DEVIATIONS * max(deviations))))
        spread = fft.ifft2(ndimage.fourier_gaussian(moved, deviations)).real
    (low, high), (left, right) = (np.sort(each).round(SAME) for each in edges)
    down = _cell_overlaps(float(low), float(high), len(spread), shape[0], cell)
    beside = _cell_overlaps(float(left), float(right), len(spread), shape[1], cell)
    return np.asarray(down.T @ spread @ beside, dtype=np.float64)
