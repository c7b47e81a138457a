"""Blurred footprints of thin lenses, and diffraction, against limits, closed forms and integrals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import GREEN
from ommatid.scenes.lens_type import LensOptics
from ommatid.scenes.optics.diffraction import TAIL, pattern
from ommatid.scenes.optics.field import FINEST
from ommatid.scenes.optics.lens_kernels import blurred_matrix, kernels
from ommatid.scenes.optics.lens_matrix import matrix, row_by_rays, row_by_waves
from ommatid.scenes.optics.point_spread import point_spread
from ommatid.scenes.optics.wavefront import thin_wavefront
from ommatid.simulate.ideal import ideal_matrix

from ..examples import camera
from ..printed_figures import check_figures

Numbers = NDArray[np.float64]

DISKS = [LensOptics(aperture=0.4, focus=800.0), LensOptics(aperture=0.4), LensOptics(pixel_blur=2e-3)]


def with_lens_optics(optics: LensOptics, wavelength: float | None = None, ratio: str = "1/3") -> Camera:
    cam = camera((19, 19), ((ratio, [3, 3], [5, 5]),))
    return replace(cam, types=(replace(cam.types[0], optics=optics),), wavelength=wavelength)


# ---- limits, sums and symmetries of H


@pytest.mark.parametrize("lenses", [(("1/3", [3, 3], [5, 5]),), (("3/10", [2, 1], [2, 3]), ("2/5", [2, 2], [3, 3]))])
def test_without_blur_entries_are_overlaps_of_boxes(lenses: tuple[tuple[str, list[int], list[int]], ...]) -> None:
    sharp = camera((19, 20), lenses)
    optics = LensOptics(aperture=0.4, focus=1000.0 * (1 + 1e-7))
    cam = replace(sharp, types=tuple(replace(each, optics=optics) for each in sharp.types))
    np.testing.assert_allclose(ideal_matrix(cam).toarray(), ideal_matrix(sharp).toarray(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("wavelength", [None, GREEN])
@pytest.mark.parametrize("optics", DISKS)
def test_light_is_conserved_and_lost_only_at_the_edges(optics: LensOptics, wavelength: float | None) -> None:
    wide = camera((139, 139), (("1/3", [1, 1], [3, 3]), ("2/5", [1, 1], [2, 2])))
    wide = replace(wide, types=tuple(replace(each, optics=optics) for each in wide.types), wavelength=wavelength)
    mass = 1 - TAIL if wavelength and optics.aperture else 1.0
    np.testing.assert_allclose(ideal_matrix(wide).sum(axis=1), mass, rtol=0, atol=1e-3)
    cam = with_lens_optics(optics, wavelength)
    result = blurred_matrix(cam, cam.types[0]) if cam.is_blurred(cam.types[0]) else ideal_matrix(cam)
    assert result.data.min() > -1e-5
    assert result.sum(axis=1).max() <= 1 + 1e-3


@pytest.mark.parametrize("wavelength", [None, GREEN])
def test_mirrored_and_transposed_cameras_are_the_same(wavelength: float | None) -> None:
    cam = with_lens_optics(DISKS[0], wavelength)  # the disks of off-axis pixels are asymmetric
    h = blurred_matrix(cam, cam.types[0]).toarray().reshape(3, 3, 5, 5, 19, 19)
    atol = 1e-5 * h.max()
    np.testing.assert_allclose(h, h.transpose(1, 0, 3, 2, 5, 4), rtol=0, atol=atol)
    np.testing.assert_allclose(h, np.flip(h, (0, 2, 4)), rtol=0, atol=atol)
    np.testing.assert_allclose(h, np.flip(h, (1, 3, 5)), rtol=0, atol=atol)


@pytest.mark.parametrize("wavelength", [None, GREEN])
@pytest.mark.parametrize("optics", [*DISKS[:2], LensOptics(aperture=1.0, focus=500.0)])
def test_kernels_are_the_entries_pixel_by_pixel(optics: LensOptics, wavelength: float | None) -> None:
    cam = with_lens_optics(optics, wavelength)
    exact = matrix(cam, cam.types[0]).toarray()
    found = kernels(cam, cam.types[0]).to_sparse().toarray()
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-3 * exact.max())


# ---- second methods


def trapezoid(t: Numbers, ratio: float) -> Numbers:
    return np.clip(np.minimum(t + 1, ratio) - np.maximum(t, 0), 0, None) / ratio


def along_lines(y: float, x: float, ratio: float, disk: float) -> float:
    """T of a disk in Cartesian coordinates: rows exactly, columns by Gauss-Legendre between all kinks."""
    radius = disk / 2
    shifts = np.array([1, 0, 1 - ratio, -ratio])

    def integral(t: Numbers) -> Numbers:
        return np.maximum(t[:, None] + shifts, 0) ** 2 @ np.array([1, -1, -1, 1]) / (2 * ratio)

    chords = np.sqrt(np.maximum(radius**2 - (y + shifts) ** 2, 0))
    kinks = np.unique(np.clip(np.concatenate([[-radius, radius], x + shifts, chords, -chords]), -radius, radius))
    nodes, weights = np.polynomial.legendre.leggauss(80)
    angle, total = np.pi / 2 * (1 + nodes), 0.0
    for low, high in pairwise(kinks):
        at = low + (high - low) * np.sin(angle / 2) ** 2
        half = np.sqrt(np.maximum((radius - at) * (radius + at), 0))
        inner = trapezoid(x - at, ratio) * (integral(y + half) - integral(y - half))
        total += (high - low) * np.pi / 4 * (weights * np.sin(angle)) @ inner
    return total / (np.pi * radius**2)


@dataclass(frozen=True)
class Blur:
    """A thin lens in pixels of f: the disk of its rays, the radius of v = 1, and (aperture / 2 depth)^2."""

    disk: float = 0.0
    airy: float = 0.0
    weight: float = 0.0

    @property
    def waves(self) -> float:
        return self.disk / (8 * np.pi * self.airy)

    def row(self, sides: tuple[float, float], width: int) -> Numbers:
        """The entries of a footprint in the middle of width x width pixels of f, seen from the lens's axis."""
        aperture = 1e-3
        depth = aperture / 2 / self.weight**0.5 if self.weight else 1e3
        focus, wavelength = 1 / (1 + self.disk / aperture), self.airy * np.pi * aperture or None
        edges = tuple(width / 2 + side / 2 * np.array([-1.0, 1.0]) for side in sides)
        wave = thin_wavefront(aperture, depth, 0.0, 1.0, focus, wavelength, finest=None if wavelength else FINEST)
        if wavelength is None:
            return row_by_rays(wave, 1.0, edges, (0.0, 0.0), (width, width))
        spread = point_spread(wave)
        return row_by_waves(spread.values, spread.cell, edges, (0.0, 0.0), (width, width))


def spectrum(blur: Blur, rho: Numbers) -> Numbers:
    """Transfer function of the whole pattern: the pupil's autocorrelation (Hopkins 1955), by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    at, share = (1 + nodes) / 2, weights / 2
    q = np.minimum(np.pi * blur.airy * rho, 1.0)[:, None, None]
    x = (1 - q) * np.sin(np.pi / 2 * at)[:, None]  # the chord's end is a square root
    dx = (1 - q) * np.pi / 2 * np.cos(np.pi / 2 * at)[:, None] * share[:, None]
    chord = np.sqrt(np.maximum(1 - (x + q) ** 2, 0))
    y = chord * at
    amplitude = [1 / (1 + blur.weight * ((x + side) ** 2 + y**2)) for side in (q, -q)]
    values = amplitude[0] * amplitude[1] * np.cos(8 * np.pi * blur.waves * q * x)
    return (4 / np.pi) * (1 + blur.weight) * (values * dx * chord * share).sum(axis=(1, 2))


def by_fourier(y: float, x: float, ratio: float, blur: Blur, count: int = 100) -> float:
    """T without truncation: the integral of its spectrum, which ends with the aperture's, in polar coordinates."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    angle = np.pi / 2 * (1 + nodes)
    rho = np.sin(angle / 2) ** 2 / (np.pi * blur.airy)
    radial = np.pi / 4 * weights * np.sin(angle) / (np.pi * blur.airy) * rho * spectrum(blur, rho)

    def axis(wave: Numbers, t: float) -> Numbers:
        return np.sinc(wave) * np.sinc(ratio * wave) * np.cos(2 * np.pi * wave * (t + 0.5 - ratio / 2))

    down, across = (np.outer(rho, turn(angle / 2)) for turn in (np.sin, np.cos))
    return float(4 * radial @ (axis(down, y) * axis(across, x)) @ (np.pi / 4 * weights))


def worst(ratio: float, row: Numbers, second: Callable[[float, float], float]) -> float:
    """Largest difference of entries from a second method of their corner (y, x), over the largest entry."""
    width, found = len(row), list[float]()
    for down, across in ((0, 0), (0, 1), (1, 1), (2, 0), (2, 3)):
        y, x = (width // 2 + step - (width - ratio) / 2 for step in (down, across))
        found.append(abs(row[width // 2 + down, width // 2 + across] - second(y, x)))
    return float(np.max(found) / row.max())


@pytest.mark.parametrize("disk", [1e-2, 0.7, 2.0, 7.3, 25.0])
@pytest.mark.parametrize("ratio", [3.0, 2.5, 1e6 / 333333])
def test_disk_against_an_integral_along_lines(ratio: float, disk: float) -> None:
    row = Blur(disk).row((ratio, ratio), 41)
    assert worst(ratio, row, lambda y, x: along_lines(y, x, ratio, disk)) < 1e-3


@pytest.mark.parametrize(
    "blur", [Blur(airy=0.44), Blur(1.0, 0.44), Blur(2.0, 0.2, weight=0.05), Blur(1e-3, 0.5, weight=0.05)]
)
@pytest.mark.parametrize("ratio", [3.0, 2.5])
def test_airy_against_fourier(ratio: float, blur: Blur) -> None:
    """So near to a footprint the light that lands beyond the grid contributes nothing."""
    assert worst(ratio, blur.row((ratio, ratio), 21), lambda y, x: by_fourier(y, x, ratio, blur)) < 1e-6


@pytest.mark.parametrize("blur", [Blur(1.3), Blur(0.7, 0.3), Blur(airy=0.3), Blur(2.0, 0.3, 0.05)])
def test_a_tall_footprint_is_the_mean_of_three_square_ones(blur: Blur) -> None:
    tall, square = blur.row((3.0, 1.0), 21), blur.row((1.0, 1.0), 21)
    mean = (square[:-2] + square[1:-1] + square[2:]) / 3
    np.testing.assert_allclose(tall[1:-1], mean, atol=1e-9)


@pytest.mark.parametrize("focus", [1000 / 6, 400.0, 1300.0])
def test_pixels_off_the_axis_follow_the_cos4_law(focus: float) -> None:
    """Rays from the middle of a sensor pixel through 200 x 200 points of the lens, weighted by their angles."""
    cam = with_lens_optics(LensOptics(aperture=0.4, focus=focus))
    exact, found = (
        h.toarray().reshape(3, 3, 5, 5, 19, 19)
        for h in (matrix(cam, cam.types[0]), kernels(cam, cam.types[0]).to_sparse())
    )
    share, angle = (np.arange(200) + 0.5) / 200, 2 * np.pi * (np.arange(200) + 0.5) / 200
    lens = [0.2 * np.outer(np.sqrt(share), turn(angle)).ravel() for turn in (np.cos, np.sin)]
    for k, l, i, j in ((0, 0, 0, 0), (1, 2, 1, 4), (2, 1, 3, 2)):  # noqa: E741
        sub = cam.sub_imager(0, k, l)
        s = [sub.patch[a] - sub.lens[a] + ((j, i)[a] - 2) * cam.pixel_pitch for a in (0, 1)]
        weights = (1 + sum((a - b) ** 2 for a, b in zip(lens, s, strict=True)) / sub.depth**2) ** -2
        axes: list[Numbers] = []
        for a, size in ((1, cam.rows), (0, cam.columns)):
            landed = sub.lens[a] + lens[a] + (-s[a] * focus / sub.depth - lens[a]) * cam.distance / focus
            corner = size / 2 - landed / cam.target_pitch - 1.5
            axes.append(trapezoid(np.arange(size)[:, None] - corner, 3.0))
        expected = (axes[0] * weights / weights.sum()) @ axes[1].T
        np.testing.assert_allclose(exact[k, l, i, j], expected, rtol=0, atol=2e-4 * expected.max())
        np.testing.assert_allclose(found[k, l, i, j], expected, rtol=0, atol=1e-3 * expected.max())


# --- diffraction of a defocused circular pupil


def test_the_strehl_ratio_of_the_documentation() -> None:
    v = np.array([1e-4])
    strehl = 2 * pattern(0.21).spread(v)[0] / v[0]
    check_figures("diffraction.md", "with 0.21 waves of defocus, the Strehl ratio is {};", strehl)


def test_the_pattern_in_focus_is_airy_s() -> None:
    psf = pattern(0.0)
    v = np.linspace(0.1, psf.end, 1000)
    np.testing.assert_allclose(psf.spread(v), 2 * special.j1(v) ** 2 / v, atol=1e-6)
    np.testing.assert_allclose(psf.within(v), 1 - special.j0(v) ** 2 - special.j1(v) ** 2, atol=1e-6)
    assert psf.encircled == pytest.approx(1 - TAIL, abs=3e-5)


@pytest.mark.parametrize("waves", [0.0, 0.05, 0.3, 2.0, 20.0])
@pytest.mark.parametrize("weight", [0.0, 0.03])
def test_the_pattern_is_the_squared_field_of_a_pupil_with_a_bright_side(waves: float, weight: float) -> None:
    """Against the field of 300 x 512 points of a pupil whose amplitude is larger on one side, squared."""
    psf, s = pattern(waves, weight), 1e-4
    assert 1 - 1.5 * TAIL < psf.encircled < 1 - 0.5 * TAIL
    nodes, shares = np.polynomial.legendre.leggauss(300)
    u, turn = (1 + nodes[:, None]) / 2, 2 * np.pi * np.arange(512) / 512
    element = shares[:, None] / 2 * u * 2 * np.pi / 512 * np.exp(2j * np.pi * waves * u**2) / (1 + weight * u**2)

    def light(v: float, angle: float, side: float) -> float:
        tilted = element * (1 + side * u * np.cos(turn) / (1 + weight * u**2))
        # A point of a pupil that is defocused outwards sends its ray outwards.
        return float(np.abs((tilted * np.exp(-1j * v * u * np.cos(turn - angle))).sum()) ** 2)

    for v in (1e-4, 0.7, 2.5, 6.0, 0.3 * psf.end, 0.9 * psf.end):
        middle = light(v, 0.4, 0.0)
        whole = 2 * np.pi**2 * 2 / (2 * (1 + weight))  # by Parseval, of v dv
        assert psf.spread(np.array([v]))[0] == pytest.approx(v * middle / whole, rel=1e-6, abs=1e-7)
        change = (light(v, 0.4, s) - light(v, 0.4, -s)) / (2 * s)
        assert psf.slant(np.array([v]))[0] * np.cos(0.4) == pytest.approx(v * change / whole, abs=1e-6)


def test_quantiles_encircle_their_shares() -> None:
    psf, share = pattern(0.3), np.linspace(0, 1, 101)
    radii = psf.quantiles(100)
    np.testing.assert_allclose(psf.within(radii) / psf.encircled, share**2, atol=2e-3)
