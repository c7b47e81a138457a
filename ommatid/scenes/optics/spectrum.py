"""The spectrum of the light: electrons per lumen by the eye's sensitivity, and the few wavelengths that stand for it.

The CIE's photometry: a radiant power S(lambda) has the luminous flux K_m times the integral of S V, with V the photopic
luminous efficiency of 1924 and K_m = 683.002 lm/W. (The SI fixes 683 lm/W at 540 THz, 555.016 nm in air, where V is
0.999997.) Wavelengths are nm in tables, and millimetres where they leave this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..constants import GREEN
from ..formats.curve import Curve, read_curve
from ..scene import Scene
from ..tables.camera import RAYS, LensTable
from ..tables.sensor import MILLIMETRE

PLANCK, LIGHT_SPEED = 6.62607015e-34, 299792458.0  # J s, m/s: exact in the SI
PEAK_EFFICACY = 683.002  # lm/W
METRES = 1e-9  # per nm
STEP, FEWEST = 0.5, 65  # nm between the points of an integral over a spectrum, and points at least
TOLERANCE = 1e-3  # of the contrast that a diffracting lens transfers, at every spatial frequency
MOST_WAVELENGTHS = 12
FREQUENCIES, POINTS = 64, 24  # of spatial frequency, and of the integral over the pupil

Bands = tuple[tuple[float, float], ...]


class Spectrum(NamedTuple):
    """Wavelengths in nm, ascending, and the radiant power that each stands for, of any unit."""

    wavelength: FloatArray
    power: FloatArray


def spectrum_of(scene: Scene) -> Spectrum:
    """The spectrum of a scene's light: `light.spectrum`, or else `camera.wavelength`, or else 550 nm."""
    if scene.light is None:
        wavelength = scene.camera.wavelength
        return Spectrum(np.array([(wavelength if isinstance(wavelength, float) else GREEN) * MILLIMETRE]), np.ones(1))
    interval, spectrum = scene.light.interval, scene.light.spectrum
    if scene.light.file is not None:
        raise InputError(f"light.spectrum: the file '{spectrum}' has not been read; read the scene's file")
    if interval is not None and interval[0] == interval[1]:
        return Spectrum(np.array([interval[0] * MILLIMETRE]), np.ones(1))
    if interval is not None:
        points: FloatArray = np.array([(round(end * MILLIMETRE, 6), 1.0) for end in interval])
    else:
        points = np.array(table(spectrum) if isinstance(spectrum, str) else spectrum)
    first, last = float(points[0, 0]), float(points[-1, 0])
    # Between the points of all curves, V's among them, the integrand is smooth: the trapezoidal rule suffices.
    even: FloatArray = np.arange(np.ceil(first / STEP), last / STEP) * STEP
    corners: tuple[FloatArray, ...] = points[:, 0], np.array(_efficiency_curve(scene))[:, 0]
    grid: FloatArray = np.unique(np.concatenate([even, np.linspace(first, last, FEWEST), *corners]))
    grid = grid[(grid >= first) & (grid <= last)]
    gaps = np.diff(grid)
    share = np.concatenate([gaps, [0.0]]) / 2 + np.concatenate([[0.0], gaps]) / 2
    return Spectrum(grid, share * np.interp(grid, points[:, 0], points[:, 1]))


@cache
def table(name: str) -> Curve:
    """A curve of the CIE: "photopic", "D65" or "LED-B3"."""
    return read_curve(Path(__file__).parent.parent / "spectra" / f"{name}.csv")


def photopic(wavelength: FloatArray) -> FloatArray:
    """V(lambda), the eye's relative sensitivity in daylight; 0 outside 360 to 830 nm."""
    return _between(table("photopic"), wavelength)


def quantum_efficiency(scene: Scene, wavelength: FloatArray) -> FloatArray:
    """Electrons per photon, 0 outside the range of a curve; 1 without a [sensor]."""
    curve = _efficiency_curve(scene)
    return np.full(wavelength.shape, curve[0][1]) if len(curve) == 1 else _between(curve, wavelength)


def _between(curve: Curve, wavelength: FloatArray) -> FloatArray:
    known: FloatArray = np.array(curve)
    return np.interp(wavelength, known[:, 0], known[:, 1], left=0.0, right=0.0)


def _efficiency_curve(scene: Scene) -> Curve:
    """Points of the quantum efficiency; a single one, at 0 nm, if it is the same everywhere."""
    efficiency = 1.0 if scene.sensor is None else scene.sensor.quantum_efficiency
    if isinstance(efficiency, str):
        raise InputError(f"sensor.quantum_efficiency: the file '{efficiency}' has not been read; read the scene's file")
    return efficiency if isinstance(efficiency, tuple) else ((0.0, float(efficiency)),)


def detected(scene: Scene) -> FloatArray:
    """Electrons per unit of radiant energy, times the power that each wavelength of `spectrum_of` stands for."""
    wavelength, power = spectrum_of(scene)
    return power * quantum_efficiency(scene, wavelength) * wavelength * METRES / (PLANCK * LIGHT_SPEED)


def electrons_per_lumen(scene: Scene) -> float:
    """Electrons that one lumen of the light frees in a second. Raises InputError for invisible light."""
    return float(np.sum(detected(scene)) / np.sum(spectrum_of(scene).power)) / efficacy(scene)


def efficacy(scene: Scene) -> float:
    """Luminous efficacy of the light's radiation, lm/W. Raises InputError for light outside 360 to 830 nm."""
    wavelength, power = spectrum_of(scene)
    lumens = PEAK_EFFICACY * float(np.sum(power * photopic(wavelength)))
    if lumens <= 0:
        key = "camera.wavelength" if scene.light is None else "light.spectrum"
        raise InputError(
            f"{scene.source}: {key}: sensor.illuminance is in lux, which measure light from 360 to 830 nm, got none of"
            f" it from {wavelength[0]:g} to {wavelength[-1]:g} nm; take a wavelength in that range"
        )
    return lumens / float(np.sum(power))


def wavelengths_of(scene: Scene) -> tuple[float | None, Bands]:
    """The mean wavelength, mm, of what a scene's camera detects, None for rays alone, and the bands if one is too few.

    Without any description of the light it is 550 nm for lenses with a width, and rays for pinholes.

    bands : wavelengths in mm and the share of electrons that each stands for, nodes of Gauss's rule, as few as change
        the contrast of a perfect diffracting lens, with and without the axial colour of each lens type, by less than
        1e-3 at any spatial frequency
    Raises InputError if none of the light is detected.
    """
    if scene.light is None:
        wavelength = scene.camera.wavelength
        if wavelength is None:
            wide = any(lens.aperture is not None or lens.surfaces is not None for lens in scene.camera.lens)
            return GREEN if wide else None, ()
        return None if wavelength == RAYS else wavelength, ()
    interval = scene.light.interval
    if interval is not None and interval[0] == interval[1]:
        return interval[0], ()
    wavelength, electrons = spectrum_of(scene).wavelength, detected(scene)
    if not electrons.any():
        raise InputError(
            f"{scene.source}: sensor.quantum_efficiency: expected a curve above 0 within the light's"
            f" {wavelength[0]:g} to {wavelength[-1]:g} nm, got none; extend it"
        )
    middle = float(wavelength @ electrons / electrons.sum())
    at, share = nodes(wavelength, electrons, [_defocus(scene, lens, wavelength, middle) for lens in scene.camera.lens])
    bands = tuple((float(node) / MILLIMETRE, float(part)) for node, part in zip(at, share, strict=True))
    return float(at @ share) / MILLIMETRE, bands if len(bands) > 1 else ()


def _defocus(scene: Scene, lens: LensTable, wavelength: FloatArray, middle: float) -> FloatArray:
    """Return the defocus, (n,), in waves at the rim of the pupil, at wavelengths in nm, of a lens in focus at one.

    By paraxial rays, 0 without surfaces. A glass whose index is unknown at a wavelength has that of the nearest one.
    """
    if lens.surfaces is None or isinstance(lens.surfaces, str):
        return np.zeros(wavelength.size)
    from .prescription import prescribe

    found = list[tuple[float, float, float]]()
    for place in map(float, np.linspace(float(wavelength[0]), float(wavelength[-1]), FEWEST)):
        with suppress(InputError):  # a range of measured indices that ends, or what is refused elsewhere
            surfaces = prescribe(lens.surfaces, place / MILLIMETRE)
            found.append((place, 1 / surfaces.focal_length, surfaces.entrance_pupil.radius))
    at, powers, radii = np.array(found).reshape(-1, 3).T
    power = np.interp(middle, at, powers) if at.size else 0.0
    if power <= 0:
        return np.zeros(wavelength.size)
    pitches = scene.target.pixel_pitch / (scene.camera.pixel_pitch * float(lens.magnification))
    distance, whole = scene.target.distance, scene.sensor_distance
    distance = distance if whole is None else whole * pitches / (1 + pitches)
    scale = lens.scale if isinstance(lens.scale, float) else power * distance / (1 + pitches)
    return radii[0] ** 2 * scale * (np.interp(wavelength, at, powers) - power) / (2 * wavelength / MILLIMETRE)


def nodes(
    wavelength: FloatArray, weight: FloatArray, defocus: Sequence[FloatArray], tolerance: float = TOLERANCE
) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights, of sum 1, of the smallest of Gauss's rules that keeps the contrast within a tolerance.

    defocus : of each lens at the wavelengths, (n,) in waves;  a lens without any is one more
    """
    waves = {tuple(each[weight > 0].tolist()) for each in (np.zeros(wavelength.size), *defocus)}
    wavelength, weight = wavelength[weight > 0], weight[weight > 0] / weight.sum()
    frequency: FloatArray = np.linspace(0.0, 1.0 / float(wavelength[0]), FREQUENCIES)[:, None]
    exact = [_contrast(frequency * wavelength, np.array(row)) @ weight for row in waves]
    at, share = gauss(wavelength, weight, 1)
    for count in range(2, MOST_WAVELENGTHS + 1):
        few = (_contrast(frequency * at, np.interp(at, wavelength, row)) @ share for row in waves)
        if all(np.abs(one - other).max() < tolerance for one, other in zip(few, exact, strict=True)):
            break
        at, share = gauss(wavelength, weight, count)
    return at, share


def _contrast(frequency: FloatArray, waves: FloatArray) -> FloatArray:
    """Contrast that a circular pupil transfers, by frequency in units of its cut-off, (n, m), and by defocus, (m,).

    4 / pi times the integral of cos^2 a cos(8 pi W s (sin a - s)) over a from arcsin s to pi / 2 (Hopkins 1955,
    Proc. R. Soc. A 231, 91): with x = sin a - s, half the pupils displaced by s overlap by cos a at x.
    """
    inside = np.minimum(frequency, 1.0)
    least = np.arcsin(inside)
    half, total = (np.pi / 2 - least) / 2, np.zeros_like(inside)
    for node, share in zip(*legendre.leggauss(POINTS), strict=True):
        angle = least + half * (1 + node)
        total += share * np.square(np.cos(angle)) * np.cos(8 * np.pi * waves * inside * (np.sin(angle) - inside))
    return 4 / np.pi * half * total


def gauss(points: FloatArray, weight: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of Gauss's rule for a discrete measure of sum 1: eigenvalues of its Jacobi matrix.

    Exact for polynomials of degree 2 count - 1 (G. H. Golub, J. H. Welsch, Math. Comp. 23, 221 (1969)). The matrix is
    multiplication by x on polynomials that are orthonormal under the measure.
    """
    middle = float(points @ weight)
    spread = float(np.sqrt(np.square(points - middle) @ weight)) or 1.0
    scaled, root = (points - middle) / spread, np.sqrt(weight)
    basis, _ = np.linalg.qr(root[:, None] * legendre.legvander(scaled, min(count, points.size) - 1))
    value, vector = np.linalg.eigh(basis.T @ (scaled[:, None] * basis))
    return middle + spread * value, np.square(vector.T @ (basis.T @ root))
