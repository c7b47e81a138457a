"""H of thin lenses and of pixels with a blur: footprints blurred by defocus, by diffraction and by charges' diffusion.

Lengths are pixels of f. Every ray of a lens type is displaced on the target by a random vector: a point of the disk of
defocus or, if the light has wavelengths, of the diffraction pattern of the defocused pupil (`diffraction`). Charges
that diffuse across the sensor before they are collected add a Gaussian one. Its
distribution is the same for all pixels and isotropic, so that

    H_ij = T(y, x) = E[trapezoid(y - dy) trapezoid(x - dx)],   trapezoid(t) = |[0, m] and [t, t + 1]| / m,

where texel j begins at (y, x) from the corner of footprint i. A trapezoid is D|t| / 2m, D|t| the difference
|t + 1| - |t| - |t + 1 - m| + |t - m|, and E|y - dy| |x - dx| = |y| |x| + 2 |y| P(|x|) + 2 |x| P(|y|) + 4 F(|y|, |x|)
for an isotropic displacement, P(x) = E (dx - x)+ and F(y, x) = E (dy - y)+ (dx - x)+. Hence with q = D P / m

    T = trapezoid trapezoid + trapezoid q(x) + q(y) trapezoid + D D F / m^2,

which is the entry without blur where P and F vanish; the first term is times the light within the pattern's largest
radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, lcm

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import check_memory

from ..camera import Camera
from ..constants import DEVIATIONS
from ..fitted.kernel_shapes import KernelShapes
from ..fitted.kernels import KernelFootprints, KernelPlaces
from ..lens_type import LensType
from .diffraction import MOST_WAVES, Pattern, end_of, pattern
from .radial_density import RadialDensity, diffused, disk_density, disk_slant, gaussian_density, moments, slopes

MOST_REACH = 1000  # pixels of f
MOST_WEIGHT = 1.0  # of f/0.5; beyond, the first order in the height of a pixel does not describe the cos^4 law
TABLES = 6  # arrays of the size of the transfer function that `matrix` holds at once
SIGNS = np.array([1, -1, -1, 1])  # of the terms of D


@dataclass(frozen=True)
class Blur:
    """Distribution of the displacement of a lens type's rays from a pinhole's, in pixels of f.

    disk : diameter of the disk of rays out of focus, 0 in focus
    airy : radius on the target where the Airy pattern (2 J1(v) / v)^2 has v = 1, 0 without diffraction
    weight : (aperture / 2 depth)^2: light through the lens's rim has (1 + weight)^-2 of the weight of that through its
        middle, the cos^4 law for a pixel on the lens's axis; 0 for a uniform pupil
    diffusion : standard deviation along an axis of the Gaussian displacement by the pixels' blur, 0 without one
    """

    disk: float = 0.0
    airy: float = 0.0
    weight: float = 0.0
    diffusion: float = 0.0

    @property
    def is_zero(self) -> bool:
        """True if no ray is displaced."""
        return self.is_sharp and self.diffusion == 0

    @property
    def is_sharp(self) -> bool:
        """True if the lens displaces no ray."""
        return self.disk == 0 and self.airy == 0

    @property
    def waves(self) -> float:
        """Defocus at the pupil's rim in wavelengths; ValueError without diffraction."""
        if self.airy == 0:
            raise ValueError("waves of defocus need a wavelength, got a blur of rays")
        return self.disk / (8 * np.pi * self.airy)

    @property
    def reach(self) -> float:
        """Largest displacement, which is added to a footprint on every side."""
        of_lens = self.airy * end_of(self.waves) if self.airy else self.disk / 2
        return of_lens + DEVIATIONS * self.diffusion

    @property
    def pattern(self) -> Pattern:
        """The diffraction pattern."""
        return pattern(self.waves, self.weight)

    @property
    def spread_density(self) -> RadialDensity:
        """Density of the displacements."""
        if self.is_sharp:
            return gaussian_density(self.diffusion)
        return self._diffused(
            self.pattern.spread_density(self.airy) if self.airy else disk_density(self.disk, self.weight)
        )

    @property
    def slant_density(self) -> RadialDensity:
        """Density whose derivative along an axis is the change for a pupil that is brighter towards that axis."""
        return self._diffused(
            self.pattern.slant_density(self.airy) if self.airy else disk_slant(self.disk, self.weight)
        )

    def _diffused(self, density: RadialDensity) -> RadialDensity:
        return diffused(density, self.diffusion) if self.diffusion else density


Blurs = tuple[tuple[Blur, float], ...]  # of the wavelengths, with their shares of the light


def blur_of(camera: Camera, lens_type: LensType, wavelength: float | None = None) -> Blur:
    """The blur of a lens type and its pixels at a wavelength, absent: the camera's; without one the disk of the rays.

    More than `MOST_WAVES` of defocus are a disk of rays too. Raises ValueError for a lens with surfaces, InputError for
    more blur than can be computed.
    """
    if lens_type.optics.surfaces is not None:
        raise ValueError(f"lens type '{lens_type.name}' has surfaces; expected a pinhole or a thin lens")
    aperture, diffusion = lens_type.optics.aperture, camera.diffusion(lens_type)
    if aperture is None:
        return Blur(diffusion=diffusion)
    wavelength = wavelength or camera.wavelength or 0.0
    disk = aperture * abs(1 - camera.distance_of(lens_type) / camera.focus(lens_type)) / camera.target_pitch
    airy = wavelength * camera.distance_of(lens_type) / np.pi / (aperture * camera.target_pitch)
    blur = Blur(disk, airy, (aperture / (2 * camera.depth(lens_type))) ** 2, diffusion)
    if airy and blur.waves > MOST_WAVES:
        blur = replace(blur, airy=0.0)
    if blur.is_zero:
        return Blur()
    if blur.weight > MOST_WEIGHT:
        number = camera.depth(lens_type) / aperture
        raise InputError(
            f"camera.lens.{lens_type.name}.aperture: expected a cone of light of f/0.5 at the sensor or narrower, the"
            f" limit of lenses in air, got f/{number:.2g}; make the aperture smaller"
        )
    if blur.reach > MOST_REACH:
        raise InputError(
            f"camera.lens.{lens_type.name}: its blur reaches {blur.reach:.3g} pixels of f, expected at most"
            f" {MOST_REACH}; change its aperture or its focus"
        )
    return blur


def blurs_of(camera: Camera, lens_type: LensType) -> Blurs:
    """The blur of a lens type at each wavelength of the light, with its share of the light."""
    shares = camera.wavelengths or ((None, 1.0),)
    return tuple((blur_of(camera, lens_type, wavelength), share) for wavelength, share in shares)


def matrix(camera: Camera, lens_type: LensType, *blurs: tuple[Blur, float]) -> sparse.csr_array:
    """H of all sub-imagers of a lens type as designed, without distortion: (its measurements, N).

    blurs : each with its share of the light, as of `blurs_of`

    Rays that miss the target bring no light: rows near its edges sum to less than 1. With a weight the blur of a pixel
    off its lens's axis is asymmetric: light through the near side of the lens has more weight. It is right to first
    order in the position s of the pixel's middle. Neglected are the second order, 12 weight (s / depth)^2 of an entry,
    the variation within a sensor pixel, and the share `diffraction.TAIL` of the light, which lands further out.
    """
    reach = max(blur.reach for blur, _ in blurs)
    numbers = lens_type.ratio, *lens_type.footprint, *lens_type.step, *lens_type.origin
    unit = lcm(*(number.denominator for number in numbers))
    down, across = (_axis(camera, lens_type, reach, axis, unit) for axis in (0, 1))
    offsets = np.unique(np.abs(np.concatenate([down.offset.ravel(), across.offset.ravel()])))  # symmetric
    table, *asymmetry = _tables(camera, lens_type, offsets, unit, blurs)
    data: list[FloatArray] = []
    indices: list[IntArray] = []
    counts: list[IntArray] = []
    for k in range(lens_type.array[0]):
        values = _block(down, across, k, offsets, table, asymmetry)
        lit = values > 0
        texels = down.cells[k][None, :, None, :, None] * camera.columns + across.cells[:, None, :, None, :]
        data.append(values[lit])
        indices.append(np.broadcast_to(texels, values.shape)[lit])
        counts.append(lit.sum(axis=(3, 4)).ravel())
    pointers = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
    shape = (lens_type.measurements, camera.unknowns)
    values = float(lens_type.light) * np.concatenate(data)
    return sparse.csr_array((values, np.concatenate(indices), pointers), shape=shape)


def _tables(camera: Camera, lens_type: LensType, offsets: IntArray, unit: int, blurs: Blurs) -> tuple[FloatArray, ...]:
    """Entries of H for all pairs of offsets down and across, and their slopes of `_asymmetry` if any: (n, n) each."""
    needed = TABLES * 8 * offsets.size**2
    check_memory(needed, f"camera.lens.{lens_type.name}: its blur", "take simpler ratios, or less blur")
    reach, (tall, wide) = max(blur.reach for blur, _ in blurs), map(float, lens_type.footprint)
    gaps = [np.maximum(offsets - unit - int(side * unit), 0) / (2 * unit) for side in lens_type.footprint]
    lit = np.hypot.outer(*gaps) < max(reach, np.finfo(float).tiny)
    table = np.where(lit, sum(share * transfer((tall, wide), offsets, unit, blur) for blur, share in blurs), 0.0)
    slanted = [(blur, share) for blur, share in blurs if blur.disk and blur.weight]
    if not slanted:
        return (table,)

    def along(sides: Sides) -> FloatArray:
        parts = (share * _asymmetry(camera, lens_type, blur, sides, offsets, unit) for blur, share in slanted)
        return sum(parts, np.zeros_like(table))

    upward = along((tall, wide))
    sideways = upward if tall == wide else along((wide, tall))
    return table, np.where(lit, upward, 0.0), np.where(lit, np.transpose(sideways), 0.0)


def kernels(camera: Camera, lens_type: LensType) -> KernelFootprints:
    """H of a lens type as designed, as of `matrix`, by a kernel, or three where light through the rim has less weight.

    Expects a camera for which `Camera.has_kernel` is true.
    """
    blurs = blurs_of(camera, lens_type)
    places = KernelPlaces(camera, lens_type, ceil(max(blur.reach for blur, _ in blurs)))
    beside = 2 * np.arange(places.width) + 1 - places.width  # from the footprint's middle, in halves of a pixel
    offsets, index = np.unique(np.abs(beside), return_inverse=True)
    unit, light = lcm(*(side.denominator for side in lens_type.footprint)), float(lens_type.light)
    table, *asymmetry = _tables(camera, lens_type, unit * offsets, unit, blurs)
    mean = table[np.ix_(index, index)]
    if not asymmetry:
        return KernelFootprints(places, 0, KernelShapes.dense(mean[None]), np.full((1, 1), light), np.zeros((0, 0, 1)))
    upward, sideways = (slope[np.ix_(index, index)] for slope in asymmetry)
    weights = np.diag([1.0, places.scale, places.scale])  # Legendre's P1 is the coordinate itself
    shapes = KernelShapes.dense(np.stack([mean, np.sign(beside)[:, None] * upward, sideways * np.sign(beside)]))
    return KernelFootprints(places, 1, shapes, light * weights, np.zeros((0, 0, 3)))


Sides = tuple[float, float]  # of a footprint, down and across, in pixels of f


def transfer(sides: Sides, offsets: IntArray, unit: int, blur: Blur) -> FloatArray:
    """T for all pairs of offsets between the middles of a texel and of a footprint along the two axes: (n, n).

    sides : of the footprint;  offsets : (n,) in halves of 1 / unit, a unit in which the sides are whole numbers
    """
    (tall, _), (wide, _) = (_trapezoid(side, offsets, unit) for side in sides)
    sharp = np.outer(tall, wide)
    if blur.is_zero:
        return sharp
    kinks, (down, _), (across, _) = _differences(sides, offsets, unit)
    density = blur.spread_density
    beyond, corner = moments(kinks, density)
    widened = np.outer(tall, across @ beyond) + np.outer(down @ beyond, wide)
    return density.mass * sharp + widened + down @ corner @ across.T


def steepness(sides: Sides, offsets: IntArray, unit: int, density: RadialDensity) -> FloatArray:
    """The derivative by y, its first coordinate, of T of displacements with a density; parameters as of `transfer`."""
    (_, steep), (wide, _) = (_trapezoid(side, offsets, unit) for side in sides)
    kinks, (_, odd), (across, _) = _differences(sides, offsets, unit)
    beyond, _ = moments(kinks, density)
    lower, corner = slopes(kinks, density)
    inside = np.outer(steep, density.mass * wide + across @ beyond)
    return inside + np.outer(odd @ lower, wide) + odd @ corner @ across.T


def _kinks(ratio: float, offsets: IntArray, unit: int) -> IntArray:
    """t + 1, t, t + 1 - m and t - m of each offset, in halves of 1 / unit: (n, 4)."""
    length = round(ratio * unit)
    return offsets[:, None] + np.array([unit + length, length - unit, unit - length, -unit - length])


def _trapezoid(ratio: float, offsets: IntArray, unit: int) -> tuple[FloatArray, FloatArray]:
    """The trapezoid and its derivative: (n,) each."""
    kinks = _kinks(ratio, offsets, unit)
    return (np.abs(kinks) @ SIGNS) / (4 * round(ratio * unit)), (np.sign(kinks) @ SIGNS) / (2 * ratio)


def _differences(
    sides: Sides, offsets: IntArray, unit: int
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Absolute values of all kinks, (k,), and for both sides matrices D / m for even and odd functions: (n, k) each."""
    kinks = np.stack([_kinks(side, offsets, unit) for side in sides])
    values, index = np.unique(np.abs(kinks), return_inverse=True)
    at = np.arange(offsets.size)[:, None]

    def matrices(axis: int) -> tuple[FloatArray, FloatArray]:
        even, odd = (np.zeros((offsets.size, values.size)) for _ in range(2))
        where = at, index.reshape(kinks.shape)[axis]
        np.add.at(even, where, SIGNS / sides[axis])
        np.add.at(odd, where, SIGNS * np.sign(kinks[axis]) / sides[axis])
        return even, odd

    return values / (2 * unit), matrices(0), matrices(1)


def _asymmetry(
    camera: Camera, lens_type: LensType, blur: Blur, sides: Sides, offsets: IntArray, unit: int
) -> FloatArray:
    """Change of an entry of H per pixel of f between a lens and the footprint of its pixel, along y: (n, n)."""
    inside = steepness(sides, offsets, unit, blur.slant_density)
    # A pixel at s sees the pupil's amplitude 2 s sqrt(weight) / depth brighter at the rim on its side.
    lever = 2 * np.sqrt(blur.weight) * camera.target_pitch / camera.distance_of(lens_type)
    return -np.sign(1 - camera.distance_of(lens_type) / camera.focus(lens_type)) * lever * inside


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


def _axis(camera: Camera, lens_type: LensType, reach: float, axis: int, unit: int) -> _Axis:
    size, count, length = camera.shape[axis], lens_type.array[axis], int(lens_type.ratio * unit)
    begin = int(lens_type.origin[axis] * unit) + int(lens_type.step[axis] * unit) * np.arange(count)
    starts = begin[:, None] + length * np.arange(lens_type.pixels[axis])
    reached = _reached(lens_type, reach, size)
    first = np.clip(np.floor(starts / unit - reach).astype(np.int64), 0, size - reached)
    cells = first[..., None] + np.arange(reached)
    index = camera.types.index(lens_type)
    subs = [camera.sub_imager(index, *((number, 0) if axis == 0 else (0, number))) for number in range(count)]
    lens = size / 2 - np.array([sub.lens[1 - axis] for sub in subs]) / camera.target_pitch
    beside = (starts + length / 2) / unit - lens[:, None]
    return _Axis(cells, 2 * (cells * unit - starts[..., None]) + unit - length, beside)


def _block(
    down: _Axis, across: _Axis, k: int, offsets: IntArray, table: FloatArray, asymmetry: Sequence[FloatArray]
) -> FloatArray:
    """Entries of the sub-imagers of row k, texels within reach: (L, rows, columns, texels down, texels across)."""
    y, x = down.offset[k : k + 1, :, None, :, None], across.offset[:, None, :, None, :]
    row, column = np.searchsorted(offsets, np.abs(y)), np.searchsorted(offsets, np.abs(x))
    values = table[row, column]
    if not asymmetry:
        return values
    upward = np.sign(y) * down.beside[k][None, :, None, None, None]
    sideways = np.sign(x) * across.beside[:, None, :, None, None]
    return values + upward * asymmetry[0][row, column] + sideways * asymmetry[1][row, column]


def _reached(lens_type: LensType, reach: float, size: int) -> int:
    """Number of texels along an axis that a footprint reaches at most."""
    return min(ceil(lens_type.ratio + Fraction(2 * reach)) + 1, size)
