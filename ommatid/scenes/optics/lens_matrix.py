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

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import ceil, pi

import numpy as np
from scipy import fft, ndimage, sparse
from scipy.special import ndtr, sici

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.machine import check_memory

from ..camera import Camera
from ..constants import DEVIATIONS
from ..lens_type import LensType
from ..pose import pixel_middles, pose_of
from .field import FINEST, Optics, bands, check_waves, optics_of
from .point_spread import point_spread
from .wavefront import Wavefront

SAME = 6  # digits of edges of footprints, which pixels of a row share
LEAST = 1e-12  # entries below are left out
ENTRY = 16  # bytes

Bands = tuple[tuple[Optics, float], ...]


@lru_cache(maxsize=4)
def matrix(camera: Camera, lens_type: LensType) -> sparse.csr_array:
    """H of all sub-imagers of a lens type, as designed, pixel by pixel: (its measurements, N).

    A row holds the light of a pixel that comes from the target: less than 1, as diffraction takes up to 0.5 per cent
    of the light beyond the grid of the point-spread function. Rows of pixels without light are empty. Neglected is the
    variation of the blur within a pixel.
    Raises InputError if the surfaces form no image, or aberrations of too many waves.
    """
    fields = optics_by_band(camera, lens_type)
    own = max(float(side) for side in lens_type.footprint) + 2 * camera.diffusion(lens_type) * DEVIATIONS
    far = max(field.reach for field, _ in fields) / camera.target_pitch
    tall, wide = (min(size, own + 2 * far + 2) for size in camera.shape)
    needed = int(lens_type.measurements * tall * wide) * ENTRY
    check_memory(needed, "H of blurred pixels", "crop the target or use fewer sub-imagers")
    subs = [sub for sub in camera.sub_imagers if sub.type == lens_type]
    places = np.concatenate([pixel_middles(camera, sub, pose_of(sub)).reshape(-1, 3)[:, :2] for sub in subs]).tolist()
    axes = [np.array(camera.shape) / 2 - np.array(sub.lens[::-1]) / camera.target_pitch for sub in subs]
    rows = [sparse.csr_array((1, camera.unknowns))] * len(places)
    for pixel in sorted(range(len(places)), key=lambda pixel: _folded(*places[pixel])):  # `_spread` keeps few
        axis, place = axes[pixel * len(subs) // len(places)], (places[pixel][0], places[pixel][1])
        values = row_at(camera, lens_type, fields, place, axis, camera.shape, interpolates=True)
        values[values < LEAST] = 0.0
        rows[pixel] = sparse.csr_array(values.reshape(1, -1))
    return sparse.csr_array(float(lens_type.light) * sparse.vstack(rows, format="csr"))


def optics_by_band(camera: Camera, lens_type: LensType) -> Bands:
    """Return a lens type at each wavelength of the light, and the share of this.

    Raises InputError if the surfaces form no image, or aberrations of too many waves.
    """
    fields = tuple((optics_of(camera, lens_type, wavelength), weight) for wavelength, weight in bands(camera))
    for field, _ in fields:
        check_waves(lens_type, field)
    return fields


def row_at(
    camera: Camera,
    lens_type: LensType,
    fields: Bands,
    place: tuple[float, float],
    axis: FloatArray,
    shape: tuple[int, int],
    *,
    interpolates: bool = False,
) -> FloatArray:
    """Return the row of H, (rows, columns) on a window of f, of the pixel at a place (x, y) from the lens's axis.

    fields : of `optics_by_band`;  axis : (2,) row and column of the lens's axis on the window, whose shape is given
    interpolates : between nodes of height, instead of tracing a wave
    """
    (x, y), pitch, blur = place, camera.target_pitch, blur_of(camera, lens_type)
    height, angle = float(np.hypot(x, y)), float(np.arctan2(-x, y))
    total, light = np.zeros(shape), 0.0
    for field, weight in fields:
        lit = weight * float(field.weight(np.array([height]))[0])
        light += lit
        if lit > 0:
            edges = tuple(axis[:, None] + edges_at(camera, field, lens_type, np.array(x), np.array(y)))
            if field.rays_suffice:
                waves = field.between(height) if interpolates else [(field.rays(height, FINEST * pitch), 1.0)]
                rows = [row_by_rays(wave.turned(angle), pitch, edges, blur, shape) * share for wave, share in waves]
                row = sum(rows, np.zeros(shape))
            else:
                spread = _spread(field, *_folded(x, y), interpolates)
                spread = (spread.T if abs(x) > abs(y) else spread)[:: -1 if y < 0 else 1, :: -1 if x < 0 else 1]
                row = row_by_waves(spread, field.grid[0] / pitch, edges, blur, shape)
            total += lit * row
    return total / light if light > 0 else total


def _folded(x: float, y: float) -> tuple[float, float]:
    """Return the place in the half quadrant beside the y axis, of which (x, y) is a mirror image, to nine digits."""
    near, far = sorted((abs(x), abs(y)))
    return float(f"{near:.9g}"), float(f"{far:.9g}")


@lru_cache(maxsize=16)
def _spread(field: Optics, x: float, y: float, interpolates: bool) -> FloatArray:
    """Return the point-spread function of a sensor point on the lens's grid, (n, n); see `row_at`."""
    height, angle = float(np.hypot(x, y)), float(np.arctan2(-x, y))
    waves = field.between(height) if interpolates else [(field.lit_wave(height), 1.0)]
    spreads = [share * point_spread(wave.turned(angle), field.grid).values for wave, share in waves]
    return np.asarray(np.sum(spreads, axis=0), dtype=np.float64)


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
