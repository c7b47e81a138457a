"""H of lenses with surfaces: the point-spread functions of traced waves, integrated over sensor pixels and pixels of f.

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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from math import ceil, pi

import numpy as np
from scipy import fft, ndimage, sparse
from scipy.special import ndtr, sici

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import DEVIATIONS
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.pose import corner_offset, pose_of

from .field import LensField, bands, check_waves, field_of

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
    """H of all sub-imagers of a lens type with surfaces, as designed: (its measurements, N).

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
    field = field_of(camera, lens_type, wavelength)
    check_waves(lens_type, field)
    pixels = _pixels(camera, lens_type, field)
    light = weight * field.brightness(np.hypot(pixels.x, pixels.y))
    return sparse.csr_array(sparse.diags_array(light) @ _rows(camera, field, pixels)), light


def _pixels(camera: Camera, lens_type: LensType, field: LensField) -> _PixelFootprints:
    parts: list[FloatArray] = []
    tall, wide = (camera.pixel_pitch / 2 * float(part) for part in lens_type.open)
    for sub in camera.sub_imagers:
        if sub.type != lens_type:
            continue
        pose = pose_of(sub)
        row, column = (index.ravel() + 0.5 for index in np.indices(lens_type.pixels))
        u, v = corner_offset(camera, sub)
        points = pose.axes @ np.stack([u + column * camera.pixel_pitch, v + row * camera.pixel_pitch])
        x, y, _ = pose.middle[:, None] + points
        left, right = (sub.lens[0] + field.centre(x + step, y)[0] for step in (-wide, wide))
        upper, lower = (sub.lens[1] + field.centre(x, y + step)[1] for step in (-tall, tall))
        columns = [camera.columns / 2 - edge / camera.target_pitch for edge in (left, right)]
        rows = [camera.rows / 2 - edge / camera.target_pitch for edge in (upper, lower)]
        parts.append(np.stack([x, y, *rows, *columns]))
    x, y, *edges = np.concatenate(parts, axis=1)
    return _PixelFootprints(x, y, np.stack(edges[:2], axis=1), np.stack(edges[2:], axis=1), blur_of(camera, lens_type))


def blur_of(camera: Camera, lens_type: LensType) -> tuple[float, float]:
    """Return the standard deviation of the blur of a type's pixels over the sides of their open part."""
    deviation = (lens_type.optics.pixel_blur or 0.0) / camera.pixel_pitch
    return deviation / float(lens_type.open[0]), deviation / float(lens_type.open[1])


def _rows(camera: Camera, field: LensField, pixels: _PixelFootprints) -> sparse.csr_array:
    count = pixels.x.size
    wide = max(field.grid[1] if not field.rays_suffice else 0.0, max(wave.spot_radius for wave in field.nodes[1]))
    own = float(np.ptp(pixels.rows[0])) * (1 + 2 * DEVIATIONS * pixels.blur[0])
    side = [min(size, own + 2 * wide / camera.target_pitch + 2) for size in camera.shape]
    needed = int(count * side[0] * side[1]) * ENTRY
    check_memory(needed, "H of a lens with surfaces", "crop the target or use fewer sub-imagers")
    rows: list[sparse.csr_array] = [sparse.csr_array((1, camera.unknowns))] * count
    lit = np.flatnonzero(field.brightness(np.hypot(pixels.x, pixels.y)) > 0)
    by_points = _by_rays if field.rays_suffice else _by_waves
    for pixel, values in by_points(camera, field, pixels, lit):
        values[values < LEAST] = 0.0
        rows[pixel] = sparse.csr_array(values.reshape(1, -1))
    return sparse.csr_array(sparse.vstack(rows, format="csr"))


def _by_rays(
    camera: Camera, field: LensField, pixels: _PixelFootprints, lit: IntArray
) -> Iterator[tuple[int, FloatArray]]:
    """Compute the entries, (rows, columns) of f, of each lit pixel from the rays of the nodes beside its height."""
    for pixel in lit.tolist():
        x, y = float(pixels.x[pixel]), float(pixels.y[pixel])
        values = np.zeros(camera.shape)
        for wave, share in field.between(float(np.hypot(x, y))):
            across, up = wave.turned(float(np.arctan2(-x, y))).hits / camera.target_pitch
            down = overlaps(pixels.rows[pixel], -up, camera.rows, blur=pixels.blur[0])
            beside = overlaps(pixels.columns[pixel], -across, camera.columns, blur=pixels.blur[1])
            values += (down * (share * wave.light)[:, None]).T @ beside
        yield pixel, values


def _by_waves(
    camera: Camera, field: LensField, pixels: _PixelFootprints, lit: IntArray
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


def _key(field: LensField, x: float, y: float) -> tuple[int, int]:
    """Return the level of direction, folded into the half quadrant beside the y axis, and of height, of a pixel."""
    levels, turns = field.steps
    angle = float(np.arctan2(min(abs(x), abs(y)), max(abs(x), abs(y))))
    return round(angle / (pi / 2) * turns), round(float(np.hypot(x, y)) / field.field * levels)


def overlaps(edges: FloatArray, offsets: FloatArray, size: int, cell: float = 0.0, blur: float = 0.0) -> FloatArray:
    """Return the share of the interval between two edges, moved by each offset, in each texel: (n, size).

    cell : spacing of the offsets, whose frequencies are left out; 0: none
    blur : standard deviation of a Gaussian by which it is moved in addition, over its length, where no cell is given
    """
    low, high = edges.min(), edges.max()
    texels = np.arange(size + 1)
    upper, lower = (_integral(edge + offsets[:, None] - texels, cell, blur * (high - low)) for edge in (high, low))
    return (upper[:, :-1] - upper[:, 1:] + lower[:, 1:] - lower[:, :-1]) / (high - low)


def _integral(t: FloatArray, cell: float, deviation: float) -> FloatArray:
    if cell:
        rate = pi / cell
        return (t * sici(rate * t)[0] + np.cos(rate * t) / rate) / pi
    if deviation:
        at = t / deviation
        return t * (ndtr(at) - 0.5) + deviation / np.sqrt(2 * pi) * np.exp(-np.square(at) / 2)
    return np.abs(t) / 2


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
    offsets = cell * (np.arange(len(spread), dtype=np.float64) - len(spread) // 2)
    down, beside = (overlaps(each, -offsets, size, cell) for each, size in zip(edges, shape, strict=True))
    return np.asarray(down.T @ spread @ beside, dtype=np.float64)
