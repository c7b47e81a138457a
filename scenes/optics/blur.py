"""H of thin lenses: footprints blurred by defocus and by diffraction.

Lengths are pixels of f. Every ray of a lens type is displaced on the target by a random vector: a point of the disk of
defocus, or of the Airy pattern, or their sum (geometric blur and the diffraction of an open aperture taken as
independent, the usual approximation). Its distribution is the same for all pixels and isotropic, so that

    H_ij = T(y, x) = E[trapezoid(y - dy) trapezoid(x - dx)],   trapezoid(t) = |[0, m] and [t, t + 1]| / m,

where texel j begins at (y, x) from the corner of footprint i. A trapezoid is D|t| / 2m, D|t| the difference
|t + 1| - |t| - |t + 1 - m| + |t - m|, and E|y - dy| |x - dx| = |y| |x| + 2 |y| P(|x|) + 2 |x| P(|y|) + 4 F(|y|, |x|)
for an isotropic displacement, P(x) = E (dx - x)+ and F(y, x) = E (dy - y)+ (dx - x)+. Hence with q = D P / m

    T = trapezoid trapezoid + trapezoid q(x) + q(y) trapezoid + D D F / m^2,

which is the entry without blur where P and F vanish.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, lcm

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import check_memory

from ..camera import Camera
from ..lens_type import LensType
from .blur_moments import airy_end, moments, quantiles, slopes

MOST_REACH = 1000  # pixels of f
MOST_RINGS = 1000  # disk of defocus in units of the Airy pattern; larger ones take minutes
TABLES = 6  # arrays of the size of the transfer function that `matrix` holds at once
SIGNS = np.array([1, -1, -1, 1])  # of the terms of D


@dataclass(frozen=True)
class Blur:
    """Distribution of the displacement of a lens type's rays from a pinhole's, in pixels of f.

    disk : diameter of the disk of defocus, 0 in focus
    airy : radius on the target where the Airy pattern (2 J1(v) / v)^2 has v = 1, 0 without diffraction
    weight : (aperture / 2 depth)^2: rays through the lens's rim have (1 + weight)^-2 of the weight of those through its
        middle, the cos^4 law for a pixel on the lens's axis; 0 for a uniform disk
    """

    disk: float = 0.0
    airy: float = 0.0
    weight: float = 0.0

    @property
    def is_zero(self) -> bool:
        """True if no ray is displaced."""
        return self.disk == 0 and self.airy == 0

    @property
    def reach(self) -> float:
        """Largest displacement, which is added to a footprint on every side."""
        return self.disk / 2 + self.airy * airy_end()

    @property
    def radii(self) -> FloatArray:
        """Radii that encircle the shares (0, 1/n, ... 1)^2 of the truncated Airy pattern: (n + 1,), n = QUANTILES."""
        return self.airy * quantiles()


def blur_of(camera: Camera, lens_type: LensType) -> Blur:
    """The blur of a lens type: a disk of diameter aperture |1 - distance / focus|, and Airy's if there is a wavelength.

    Raises ValueError for a lens with surfaces, whose blur is not a disk, InputError for more blur than can be computed.
    """
    if lens_type.optics.surfaces is not None:
        raise ValueError(f"lens type '{lens_type.name}' has surfaces; expected a pinhole or a thin lens")
    aperture = lens_type.optics.aperture
    if aperture is None:
        return Blur()
    disk = aperture * abs(1 - camera.distance / camera.focus(lens_type)) / camera.target_pitch
    scale = 0.0 if camera.wavelength is None else camera.wavelength * camera.distance / np.pi
    weight = (aperture / (2 * camera.depth(lens_type))) ** 2 if disk else 0.0
    blur = Blur(disk, scale / (aperture * camera.target_pitch), weight)
    if blur.reach > MOST_REACH:
        raise InputError(
            f"camera.lens.{lens_type.name}: its blur reaches {blur.reach:.3g} pixels of f, expected at most"
            f" {MOST_REACH}; change its aperture or its focus"
        )
    if blur.airy and disk > MOST_RINGS * blur.airy:
        raise InputError(
            f"camera.lens.{lens_type.name}: the disk of defocus is {disk / blur.airy:.3g} times as wide as the"
            f" diffraction, expected at most {MOST_RINGS}; remove camera.wavelength, as diffraction is negligible"
        )
    return blur


def matrix(camera: Camera, lens_type: LensType, blur: Blur) -> sparse.csr_array:
    """H of all sub-imagers of a lens type as designed, without distortion: (its measurements, N).

    Rays that miss the target bring no light: rows near its edges sum to less than 1. With a weight the disk of a pixel
    off its lens's axis is asymmetric: rays through the near side of the lens have more weight. To first order in the
    position s of the pixel's middle the weight w(a) of the lens point a becomes w(a) - s . grad w(a) inside the disk,
    and that gradient is the weighted disk's minus that of a uniform one of the height of its rim. Neglected are the
    second order, 12 weight (s / depth)^2 of an entry, and the variation of w within a sensor pixel.
    """
    unit = lcm(*(number.denominator for number in (lens_type.ratio, *lens_type.step, *lens_type.origin)))
    down, across = (_axis(camera, lens_type, blur, axis, unit) for axis in (0, 1))
    offsets = np.unique(np.abs(np.concatenate([down.offset.ravel(), across.offset.ravel()])))  # symmetric
    needed = TABLES * 8 * offsets.size**2
    check_memory(needed, f"camera.lens.{lens_type.name}: its blur", "take simpler ratios, or less blur")
    gap = np.maximum(offsets - unit - int(lens_type.ratio * unit), 0) / (2 * unit)
    lit = np.hypot.outer(gap, gap) < max(blur.reach, np.finfo(float).tiny)
    table = np.where(lit, transfer(float(lens_type.ratio), offsets, unit, blur), 0.0)
    slope = (
        np.where(lit, _asymmetry(camera, lens_type, blur, offsets, unit), 0.0) if blur.disk and blur.weight else None
    )
    data: list[FloatArray] = []
    indices: list[IntArray] = []
    counts: list[IntArray] = []
    for k in range(lens_type.array[0]):
        values = _block(down, across, k, offsets, table, slope)
        lit = values > 0
        texels = down.cells[k][None, :, None, :, None] * camera.columns + across.cells[:, None, :, None, :]
        data.append(values[lit])
        indices.append(np.broadcast_to(texels, values.shape)[lit])
        counts.append(lit.sum(axis=(3, 4)).ravel())
    pointers = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
    shape = (lens_type.measurements, camera.unknowns)
    return sparse.csr_array((np.concatenate(data), np.concatenate(indices), pointers), shape=shape)


def entries(camera: Camera, lens_type: LensType, blur: Blur) -> int:
    """Upper bound of the number of entries of `matrix`, to check that it fits into memory."""
    tall, wide = (_reached(lens_type, blur, size) for size in camera.shape)
    return lens_type.measurements * tall * wide


def transfer(ratio: float, offsets: IntArray, unit: int, blur: Blur) -> FloatArray:
    """T for all pairs of offsets between the middles of a texel and of a footprint along the two axes: (n, n).

    offsets : (n,) in halves of 1 / unit, a unit in which footprints of `ratio` are whole numbers
    """
    trapezoid, _ = _trapezoid(ratio, offsets, unit)
    sharp = np.outer(trapezoid, trapezoid)
    if blur.is_zero:
        return sharp
    kinks, even, _ = _differences(ratio, offsets, unit)
    beyond, corner = moments(kinks, blur.disk, blur.airy, blur.weight)
    widened = np.outer(trapezoid, even @ beyond)
    return sharp + widened + widened.T + even @ corner @ even.T


def steepness(ratio: float, offsets: IntArray, unit: int, blur: Blur) -> FloatArray:
    """The derivative of T by y, its first coordinate, for a blur that is not zero; parameters as of `transfer`."""
    trapezoid, steep = _trapezoid(ratio, offsets, unit)
    kinks, even, odd = _differences(ratio, offsets, unit)
    beyond, _ = moments(kinks, blur.disk, blur.airy, blur.weight)
    lower, corner = slopes(kinks, blur.disk, blur.airy, blur.weight)
    return np.outer(steep, trapezoid + even @ beyond) + np.outer(odd @ lower, trapezoid) + odd @ corner @ even.T


def _kinks(ratio: float, offsets: IntArray, unit: int) -> IntArray:
    """t + 1, t, t + 1 - m and t - m of each offset, in halves of 1 / unit: (n, 4)."""
    length = round(ratio * unit)
    return offsets[:, None] + np.array([unit + length, length - unit, unit - length, -unit - length])


def _trapezoid(ratio: float, offsets: IntArray, unit: int) -> tuple[FloatArray, FloatArray]:
    """The trapezoid and its derivative: (n,) each."""
    kinks = _kinks(ratio, offsets, unit)
    return (np.abs(kinks) @ SIGNS) / (4 * round(ratio * unit)), (np.sign(kinks) @ SIGNS) / (2 * ratio)


def _differences(ratio: float, offsets: IntArray, unit: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Absolute values of all kinks, (k,), and the matrices D / m for even and odd functions of them: (n, k) each."""
    kinks = _kinks(ratio, offsets, unit)
    values, index = np.unique(np.abs(kinks), return_inverse=True)
    even, odd = (np.zeros((offsets.size, values.size)) for _ in range(2))
    at = np.arange(offsets.size)[:, None], index.reshape(kinks.shape)
    np.add.at(even, at, SIGNS / ratio)
    np.add.at(odd, at, SIGNS * np.sign(kinks) / ratio)
    return values / (2 * unit), even, odd


def _asymmetry(camera: Camera, lens_type: LensType, blur: Blur, offsets: IntArray, unit: int) -> FloatArray:
    """Change of an entry of H per pixel of f between a lens and the footprint of its pixel, along y: (n, n)."""
    uniform = replace(blur, weight=0.0)
    ratio = float(lens_type.ratio)
    inside = steepness(ratio, offsets, unit, blur) - steepness(ratio, offsets, unit, uniform) / (1 + blur.weight)
    # |1 - distance / focus| depth / distance: shift of the middle of the weights on the target.
    lever = blur.disk / 2 / np.sqrt(blur.weight) * camera.target_pitch / camera.distance
    return np.sign(1 - camera.distance / camera.focus(lens_type)) * lever * inside


@dataclass(frozen=True)
class _Axis:
    """The w texels within reach of each of K x n intervals along an axis, sub-imagers by pixels.

    cells : (K, n, w) indices of the texels
    offset : (K, n, w) from an interval's middle to a texel's, in halves of 1 / unit
    beside : (K, n) from the lens to the interval's middle, in pixels of f
    """

    cells: IntArray
    offset: IntArray
    beside: FloatArray


def _axis(camera: Camera, lens_type: LensType, blur: Blur, axis: int, unit: int) -> _Axis:
    size, count, length = camera.shape[axis], lens_type.array[axis], int(lens_type.ratio * unit)
    begin = int(lens_type.origin[axis] * unit) + int(lens_type.step[axis] * unit) * np.arange(count)
    starts = begin[:, None] + length * np.arange(lens_type.pixels[axis])
    reached = _reached(lens_type, blur, size)
    first = np.clip(np.floor(starts / unit - blur.reach).astype(np.int64), 0, size - reached)
    cells = first[..., None] + np.arange(reached)
    index = camera.types.index(lens_type)
    subs = [camera.sub_imager(index, *((number, 0) if axis == 0 else (0, number))) for number in range(count)]
    lens = size / 2 - np.array([sub.lens[1 - axis] for sub in subs]) / camera.target_pitch
    beside = (starts + length / 2) / unit - lens[:, None]
    return _Axis(cells, 2 * (cells * unit - starts[..., None]) + unit - length, beside)


def _block(
    down: _Axis, across: _Axis, k: int, offsets: IntArray, table: FloatArray, slope: FloatArray | None
) -> FloatArray:
    """Entries of the sub-imagers of row k, texels within reach: (L, rows, columns, texels down, texels across)."""
    y, x = down.offset[k : k + 1, :, None, :, None], across.offset[:, None, :, None, :]
    row, column = np.searchsorted(offsets, np.abs(y)), np.searchsorted(offsets, np.abs(x))
    values = table[row, column]
    if slope is None:
        return values
    upward = np.sign(y) * down.beside[k][None, :, None, None, None]
    sideways = np.sign(x) * across.beside[:, None, :, None, None]
    return values + upward * slope[row, column] + sideways * slope[column, row]


def _reached(lens_type: LensType, blur: Blur, size: int) -> int:
    """Number of texels along an axis that a footprint reaches at most."""
    return min(ceil(lens_type.ratio + Fraction(2 * blur.reach)) + 1, size)
