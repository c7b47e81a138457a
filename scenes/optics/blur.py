"""H of a camera whose pinholes are lenses: footprints blurred by defocus and by diffraction.

Lengths are pixels of f, the target's. Every ray of a lens type is displaced on the target by a random vector: a point
of the disk of defocus, or of the Airy pattern, or their sum (geometric blur and the diffraction of an open aperture
taken as independent, the usual approximation). The displacement is the same for all pixels and isotropic, so that

    H_ij = T(y, x) = E[trapezoid(y - dy) trapezoid(x - dx)],   trapezoid(t) = |[0, m] and [t, t + 1]| / m,

where texel j begins at (y, x) from the corner of footprint i. A trapezoid is D|t| / 2m, D|t| the difference
|t + 1| - |t| - |t + 1 - m| + |t - m|, and E|y - dy| |x - dx| = |y| |x| + 2 |y| P(|x|) + 2 |x| P(|y|) + 4 F(|y|, |x|)
for an isotropic displacement, P(x) = E (dx - x)+ and F(y, x) = E (dy - y)+ (dx - x)+. Hence with q = D P / m

    T = trapezoid trapezoid + trapezoid q(x) + q(y) trapezoid + D D F / m^2,

exactly what it is without blur where P and F vanish.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, lcm

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import check_memory

from ..camera import Camera
from ..lens_type import LensType
from .blur_moments import QUANTILES, TAIL, airy_end, moments, quantiles, slopes

Numbers = NDArray[np.float64]
Whole = NDArray[np.int64]

MOST_REACH = 1000  # pixels of f
MOST_RINGS = 1000  # of a disk of defocus, in units of the Airy pattern: minutes of work
TABLES = 6  # arrays of the size of the transfer function, beside the matrix
SIGNS = np.array([1, -1, -1, 1])  # of D


@dataclass(frozen=True)
class Blur:
    """How far rays of a lens type land from where a pinhole's would, in pixels of f.

    disk : diameter of the disk of defocus, 0 in focus
    airy : radius on the target where the Airy pattern (2 J1(v) / v)^2 has v = 1, 0 without diffraction
    weight : (aperture / 2 depth)^2: rays through the lens's rim weigh (1 + weight)^-2 of those through its middle, the
        cos^4 law for a pixel on the lens's axis; 0 for a uniform disk
    """

    disk: float = 0.0
    airy: float = 0.0
    weight: float = 0.0

    @property
    def is_zero(self) -> bool:
        """Whether rays go where a pinhole's would."""
        return self.disk == 0 and self.airy == 0

    @property
    def reach(self) -> float:
        """Largest displacement, by which a footprint grows on every side."""
        return self.disk / 2 + self.airy * airy_end()

    @property
    def lost(self) -> float:
        """Share of the light, cut off far away, that is given to the rest instead.

        Nowhere is an entry of H wrong by more than this share of the larger of itself and of what the lost light
        alone would make of it.
        """
        return TAIL if self.airy else 0.0

    def radius_of(self, share: Numbers) -> Numbers:
        """Radius of the Airy pattern, cut off, that encircles a share of its light, 0 to 1: linear between `radii`."""
        return np.interp(np.sqrt(share), np.linspace(0.0, 1.0, QUANTILES + 1), self.radii)

    @property
    def radii(self) -> Numbers:
        """Radii that encircle the shares (0, 1/n, ... 1)^2 of the Airy pattern, cut off: (n + 1,), n = QUANTILES."""
        return self.airy * quantiles()


def blur_of(camera: Camera, kind: LensType) -> Blur:
    """The blur of a lens type's thin lenses: aperture |1 - distance / focus| wide, Airy's where there is a wavelength.

    Raises ValueError for a lens of surfaces, whose blur is no disk, InputError for more blur than can be computed.
    """
    if kind.optics.surfaces is not None:
        raise ValueError(f"lens type '{kind.name}' has surfaces; expected a pinhole or a thin lens")
    aperture = kind.optics.aperture
    if aperture is None:
        return Blur()
    disk = aperture * abs(1 - camera.distance / camera.focus(kind)) / camera.target_pitch
    turn = 0.0 if camera.wavelength is None else camera.wavelength * camera.distance / np.pi
    weight = (aperture / (2 * camera.depth(kind))) ** 2 if disk else 0.0
    blur = Blur(disk, turn / (aperture * camera.target_pitch), weight)
    if blur.reach > MOST_REACH:
        raise InputError(
            f"camera.lens.{kind.name}: rays land up to {blur.reach:.3g} pixels of f beside where a pinhole's would, at"
            f" most {MOST_REACH} are served; mend its aperture or its focus"
        )
    if blur.airy and disk > MOST_RINGS * blur.airy:
        raise InputError(
            f"camera.lens.{kind.name}: the disk of defocus is {disk / blur.airy:.3g} times as wide as what diffraction"
            " adds, which no pixel tells; remove camera.wavelength"
        )
    return blur


def matrix(camera: Camera, kind: LensType, blur: Blur) -> sparse.csr_array:
    """H of all sub-imagers of a lens type as designed, without distortion: (its measurements, N).

    Light that lands beside the target is lost: rows near its edges sum to less than 1. With a weight the disk of a
    pixel off its lens's axis is lopsided: rays through the near side of the lens weigh more. To first order in the
    place s of the pixel's middle the weight w(a) of the lens point a becomes w(a) - s . grad w(a) inside the disk, and
    that gradient is the weighted disk's less that of an even one as high as its rim. What is left out is of second
    order, 12 weight (s / depth)^2 of an entry, and how w varies within a sensor pixel.
    """
    unit = lcm(kind.ratio.denominator, kind.step.denominator)
    down, across = (_axis(camera, kind, blur, axis, unit) for axis in (0, 1))
    known = np.unique(np.abs(np.concatenate([down.apart.ravel(), across.apart.ravel()])))  # both sides look alike
    check_memory(TABLES * 8 * known.size**2, f"camera.lens.{kind.name}: its blur", "take rounder ratios, or less of it")
    gap = np.maximum(known - unit - int(kind.ratio * unit), 0) / (2 * unit)
    lit = np.hypot.outer(gap, gap) < max(blur.reach, np.finfo(float).tiny)
    table = np.where(lit, transfer(float(kind.ratio), known, unit, blur), 0.0)
    slope = np.where(lit, _lopsided(camera, kind, blur, known, unit), 0.0) if blur.disk and blur.weight else None
    data: list[Numbers] = []
    indices: list[Whole] = []
    counts: list[Whole] = []
    for k in range(kind.array[0]):
        values = _block(down, across, k, known, table, slope)
        lit = values > 0
        texels = down.cells[k][None, :, None, :, None] * camera.columns + across.cells[:, None, :, None, :]
        data.append(values[lit])
        indices.append(np.broadcast_to(texels, values.shape)[lit])
        counts.append(lit.sum(axis=(3, 4)).ravel())
    pointers = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
    shape = (kind.measurements, camera.unknowns)
    return sparse.csr_array((np.concatenate(data), np.concatenate(indices), pointers), shape=shape)


def entries(camera: Camera, kind: LensType, blur: Blur) -> int:
    """At most so many entries `matrix` stores: diffraction reaches far, and a frame's H need not fit into memory."""
    tall, wide = (_wide(kind, blur, size) for size in camera.shape)
    return kind.measurements * tall * wide


def transfer(ratio: float, known: Whole, unit: int, blur: Blur) -> Numbers:
    """T for every two of `known`, distances between the middles of a texel and of a footprint along each axis.

    known : (n,) distances in halves of 1 / unit, so that footprints of `ratio` are whole; returns (n, n)
    """
    trapezoid, _ = _trapezoid(ratio, known, unit)
    sharp = np.outer(trapezoid, trapezoid)
    if blur.is_zero:
        return sharp
    places, even, _ = _differences(ratio, known, unit)
    beyond, corner = moments(places, blur.disk, blur.airy, blur.weight)
    widened = np.outer(trapezoid, even @ beyond)
    return sharp + widened + widened.T + even @ corner @ even.T


def steepness(ratio: float, known: Whole, unit: int, blur: Blur) -> Numbers:
    """The derivative of T by y, the first of its coordinates, as `transfer` gives T of a blur that is not none."""
    trapezoid, steep = _trapezoid(ratio, known, unit)
    places, even, odd = _differences(ratio, known, unit)
    beyond, _ = moments(places, blur.disk, blur.airy, blur.weight)
    lower, corner = slopes(places, blur.disk, blur.airy, blur.weight)
    return np.outer(steep, trapezoid + even @ beyond) + np.outer(odd @ lower, trapezoid) + odd @ corner @ even.T


def _kinks(ratio: float, known: Whole, unit: int) -> Whole:
    """t + 1, t, t + 1 - m and t - m of each of `known`, in halves of 1 / unit: (n, 4)."""
    length = round(ratio * unit)
    return known[:, None] + np.array([unit + length, length - unit, unit - length, -unit - length])


def _trapezoid(ratio: float, known: Whole, unit: int) -> tuple[Numbers, Numbers]:
    """The trapezoid and its derivative: (n,) each."""
    kinks = _kinks(ratio, known, unit)
    return (np.abs(kinks) @ SIGNS) / (4 * round(ratio * unit)), (np.sign(kinks) @ SIGNS) / (2 * ratio)


def _differences(ratio: float, known: Whole, unit: int) -> tuple[Numbers, Numbers, Numbers]:
    """Places of all kinks, (k,), and the matrices D / m of what is even or odd in them: (n, k) each."""
    kinks = _kinks(ratio, known, unit)
    places, numbers = np.unique(np.abs(kinks), return_inverse=True)
    even, odd = (np.zeros((known.size, places.size)) for _ in range(2))
    at = np.arange(known.size)[:, None], numbers.reshape(kinks.shape)
    np.add.at(even, at, SIGNS / ratio)
    np.add.at(odd, at, SIGNS * np.sign(kinks) / ratio)
    return places / (2 * unit), even, odd


def _lopsided(camera: Camera, kind: LensType, blur: Blur, known: Whole, unit: int) -> Numbers:
    """What H gains for each pixel of f between a lens and the footprint of its pixel, along y: (n, n)."""
    even = replace(blur, weight=0.0)
    ratio = float(kind.ratio)
    inside = steepness(ratio, known, unit, blur) - steepness(ratio, known, unit, even) / (1 + blur.weight)
    # |1 - distance / focus| depth / distance: how far the middle of the weights moves on the target.
    lever = blur.disk / 2 / np.sqrt(blur.weight) * camera.target_pitch / camera.distance
    return np.sign(1 - camera.distance / camera.focus(kind)) * lever * inside


@dataclass(frozen=True)
class _Axis:
    """The w texels within reach of each of K x n intervals along an axis, sub-imagers by pixels.

    cells : (K, n, w), which texels
    apart : (K, n, w), from an interval's middle to a texel's, in halves of 1 / unit
    beside : (K, n), from the lens to the interval's middle, in pixels of f
    """

    cells: Whole
    apart: Whole
    beside: Numbers


def _axis(camera: Camera, kind: LensType, blur: Blur, axis: int, unit: int) -> _Axis:
    size, count, length = camera.shape[axis], kind.array[axis], int(kind.ratio * unit)
    begin = kind.origin[axis] * unit + int(kind.step * unit) * np.arange(count)
    starts = begin[:, None] + length * np.arange(kind.pixels[axis])
    wide = _wide(kind, blur, size)
    first = np.clip(np.floor(starts / unit - blur.reach).astype(np.int64), 0, size - wide)
    cells = first[..., None] + np.arange(wide)
    place = camera.types.index(kind)
    subs = [camera.sub_imager(place, *((number, 0) if axis == 0 else (0, number))) for number in range(count)]
    lens = size / 2 - np.array([sub.lens[1 - axis] for sub in subs]) / camera.target_pitch
    beside = (starts + length / 2) / unit - lens[:, None]
    return _Axis(cells, 2 * (cells * unit - starts[..., None]) + unit - length, beside)


def _block(down: _Axis, across: _Axis, k: int, known: Whole, table: Numbers, slope: Numbers | None) -> Numbers:
    """H of the sub-imagers of one row, texels within reach: (L, rows, columns, texels down, texels across)."""
    y, x = down.apart[k : k + 1, :, None, :, None], across.apart[:, None, :, None, :]
    row, column = np.searchsorted(known, np.abs(y)), np.searchsorted(known, np.abs(x))
    values = table[row, column]
    if slope is None:
        return values
    upward = np.sign(y) * down.beside[k][None, :, None, None, None]
    sideways = np.sign(x) * across.beside[:, None, :, None, None]
    return values + upward * slope[row, column] + sideways * slope[column, row]


def _wide(kind: LensType, blur: Blur, size: int) -> int:
    return min(ceil(kind.ratio + Fraction(2 * blur.reach)) + 1, size)
