"""Blurred footprints against limits, Fourier integrals and integrals along lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import AIRY_FIRST_ZERO, GREEN
from ommatid.scenes.lens_type import LensOptics
from ommatid.scenes.optics.blur import Blur, blur_of, matrix, steepness, transfer
from ommatid.scenes.optics.diffraction import TAIL
from ommatid.scenes.tables.camera import Surface
from ommatid.simulate.ideal import ideal_matrix

from ..examples import camera

Numbers = NDArray[np.float64]

BLURS = [Blur(disk=1.3), Blur(disk=1.3, weight=0.04), Blur(airy=0.44), Blur(1.3, 0.44), Blur(1.3, 0.1, weight=0.04)]


def whole(cam: Camera, blur: Blur) -> Numbers:
    return np.concatenate([of_type(cam, cam.types.index(lens_type), blur) for lens_type in cam.types])


def of_type(cam: Camera, index: int, blur: Blur) -> Numbers:
    return matrix(cam, cam.types[index], (blur, 1.0)).toarray()


def with_lens_optics(optics: LensOptics, wavelength: float | None = None) -> Camera:
    cam = camera((19, 19), (("1/3", [3, 3], [5, 5]),))
    return replace(cam, types=(replace(cam.types[0], optics=optics),), wavelength=wavelength)


# ---- the blur of a camera


def test_rays_through_the_rim_of_the_lens_land_on_the_rim_of_the_disk() -> None:
    """The ray from s through the lens point a meets -s focus / depth in the plane in focus."""
    cam = with_lens_optics(LensOptics(aperture=0.4, focus=800.0))
    blur, s, depth = blur_of(cam, cam.types[0]), 0.07, cam.depth(cam.types[0])
    landed = [a + (-s * 800 / depth - a) * cam.distance / 800 for a in (-0.2, 0.2)]
    assert blur.disk == pytest.approx(abs(landed[1] - landed[0]) / cam.target_pitch, rel=1e-12)
    at_rim, on_axis = (depth / np.hypot(depth, a) for a in (0.2, 0.0))
    assert (1 + blur.weight) ** -2 == pytest.approx((at_rim / on_axis) ** 4, rel=1e-12)
    assert blur.airy == 0


def test_the_first_dark_ring_is_at_1_22_wavelengths_over_the_aperture() -> None:
    cam = with_lens_optics(LensOptics(aperture=0.4), wavelength=550e-6)
    blur = blur_of(cam, cam.types[0])
    assert special.jn_zeros(1, 1)[0] * blur.airy * cam.target_pitch == pytest.approx(
        AIRY_FIRST_ZERO * GREEN / 0.4 * 1000, rel=1e-6
    )
    assert blur.disk == 0


def test_pinholes_have_no_blur_and_surfaces_are_refused() -> None:
    cam = with_lens_optics(LensOptics(), wavelength=550e-6)
    assert blur_of(cam, cam.types[0]).is_zero
    real = with_lens_optics(LensOptics(surfaces=(Surface(semi_diameter="1 mm"),)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="thin lens"):
        blur_of(real, real.types[0])


# ---- limits, sums and symmetries of H


def test_without_blur_entries_are_overlaps_of_boxes() -> None:
    for cam in (camera(), camera((11, 12), (("3/10", [2, 1], [2, 3]), ("2/5", [2, 2], [3, 3])))):
        ideal = ideal_matrix(cam)
        sharp = whole(cam, Blur())
        np.testing.assert_allclose(sharp, ideal.toarray(), rtol=0, atol=1e-15)
        assert np.count_nonzero(sharp) == ideal.nnz
        for blur in (Blur(disk=1e-6), Blur(airy=1e-6), Blur(1e-6, 1e-7)):
            mass = blur.spread_density.mass
            np.testing.assert_allclose(whole(cam, blur), mass * ideal.toarray(), rtol=0, atol=blur.disk + 5 * blur.airy)


@pytest.mark.parametrize("blur", BLURS)
def test_light_is_conserved_and_lost_only_at_the_edges(blur: Blur) -> None:
    wide = camera((139, 139), (("1/3", [1, 1], [3, 3]), ("2/5", [1, 1], [2, 2])))
    mass = blur.spread_density.mass
    assert mass == pytest.approx(1 - TAIL if blur.airy else 1, abs=3e-4)
    np.testing.assert_allclose(whole(wide, blur).sum(axis=1), mass, rtol=0, atol=1e-12)
    result = whole(camera(), blur)
    assert result.min() >= 0
    assert result.sum(axis=1).max() <= 1 + 1e-12
    assert result.sum(axis=1).min() < 0.99


@pytest.mark.parametrize("blur", BLURS)
def test_mirrored_and_transposed_cameras_are_the_same(blur: Blur) -> None:
    cam = with_lens_optics(
        LensOptics(aperture=0.4, focus=800.0)
    )  # weights make the disks of off-axis pixels asymmetric
    h = of_type(cam, 0, blur).reshape(3, 3, 5, 5, 19, 19)
    np.testing.assert_allclose(h, h.transpose(1, 0, 3, 2, 5, 4), rtol=0, atol=1e-15)
    np.testing.assert_allclose(h, np.flip(h, (0, 2, 4)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(h, np.flip(h, (1, 3, 5)), rtol=0, atol=1e-15)


def test_zero_entries_are_not_stored() -> None:
    cam = camera()
    for lens_type in cam.types:
        for blur in BLURS[:2]:
            result = matrix(cam, lens_type, (blur, 1.0))
            assert result.data.min() > 0
            assert result.has_sorted_indices


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


def compare(
    ratio: float, offsets: list[int], unit: int, blur: Blur, second: Callable[[float, float], float]
) -> tuple[Numbers, Numbers]:
    """T at pairs of offsets, and by a second method of (y, x)."""
    result = transfer((ratio, ratio), np.array(offsets), unit, blur)
    start = [(position / unit - 1 + ratio) / 2 for position in offsets]
    return result, np.array([[second(y, x) for x in start] for y in start])


RATIOS = [(3.0, [0, 2, 4, 6], 1), (2.5, [1, 5, 9, 15], 2), (1e6 / 333333, [7, 650001, 1320001, 1433331], 333333)]


@pytest.mark.parametrize("disk", [1e-2, 0.7, 2.0, 7.3])
@pytest.mark.parametrize(("ratio", "offsets", "unit"), RATIOS)
def test_disk_against_an_integral_along_lines(ratio: float, offsets: list[int], unit: int, disk: float) -> None:
    result, expected = compare(ratio, offsets, unit, Blur(disk), lambda y, x: along_lines(y, x, ratio, disk))
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "blur",
    [Blur(airy=0.44), Blur(1.0, 0.44), Blur(2.0, 0.2, weight=0.05), Blur(1e-3, 0.5, weight=0.05)],
)
@pytest.mark.parametrize(
    ("ratio", "offsets", "unit"), [RATIOS[0], *(pytest.param(*each, marks=pytest.mark.slow) for each in RATIOS[1:])]
)
def test_airy_against_fourier(ratio: float, offsets: list[int], unit: int, blur: Blur) -> None:
    """So near to a footprint the light that lands beyond the reach contributes nothing."""
    assert offsets[-1] / unit / 2 + ratio / 2 + 1 < blur.reach / np.sqrt(2)
    result, expected = compare(ratio, offsets, unit, blur, lambda y, x: by_fourier(y, x, ratio, blur))
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("blur", [Blur(0.0), Blur(1.3), Blur(0.7, 0.3), Blur(airy=0.3), Blur(2.0, 0.3, 0.05)])
def test_a_tall_footprint_is_the_mean_of_three_square_ones(blur: Blur) -> None:
    offsets = np.arange(0, 12, 2)
    tall = transfer((3.0, 1.0), offsets, 1, blur)
    squares = transfer((1.0, 1.0), np.arange(0, 14, 2), 1, blur)
    above, below = squares[np.abs(np.arange(6) - 1)], squares[1:]
    np.testing.assert_allclose(tall, (above + squares[:6] + below)[:, :6] / 3, atol=1e-12)


@pytest.mark.parametrize("sides", [(3.0, 3.0), (1.0, 3.0), (2.5, 1.5)])
@pytest.mark.parametrize("blur", [Blur(1.3), Blur(0.7, 0.3), Blur(airy=0.3), Blur(2.0, 0.3, 0.05)])
def test_steepness_is_the_derivative_of_transfer(blur: Blur, sides: tuple[float, float]) -> None:
    unit, positions = 1000, np.array([0, 400, 2000, 2600, 3999, 5200])
    offsets = np.concatenate([positions, positions + 2, np.abs(positions - 2)])  # h = 1 / unit; T is symmetric
    after, before = np.split(transfer(sides, offsets, unit, blur)[:, : positions.size], 3)[1:]
    result = steepness(sides, positions, unit, blur.spread_density)
    np.testing.assert_allclose(result, (after - before) * unit / 2, rtol=0, atol=1e-5)


@pytest.mark.parametrize("focus", [1000 / 6, 400.0, 1300.0])
def test_pixels_off_the_axis_follow_the_cos4_law(focus: float) -> None:
    """Rays from the middle of a sensor pixel through 200 x 200 points of the lens, weighted by their angles."""
    cam = with_lens_optics(LensOptics(aperture=0.4, focus=focus))
    blur = blur_of(cam, cam.types[0])
    uniform = of_type(cam, 0, replace(blur, weight=0.0))
    result = (of_type(cam, 0, blur) - uniform).reshape(3, 3, 5, 5, 19, 19)
    share, angle = (np.arange(200) + 0.5) / 200, 2 * np.pi * (np.arange(200) + 0.5) / 200
    lens = [0.2 * np.outer(np.sqrt(share), turn(angle)).ravel() for turn in (np.cos, np.sin)]
    largest = 0.0
    for k, l, i, j in ((0, 0, 0, 0), (1, 2, 1, 4), (2, 1, 3, 2)):  # noqa: E741
        sub = cam.sub_imager(0, k, l)
        s = [sub.patch[a] - sub.lens[a] + ((j, i)[a] - 2) * cam.pixel_pitch for a in (0, 1)]
        weights = (1 + sum((a - b) ** 2 for a, b in zip(lens, s, strict=True)) / sub.depth**2) ** -2
        excess = weights / weights.sum() - 1 / weights.size
        axes: list[Numbers] = []
        for a, size in ((1, cam.rows), (0, cam.columns)):
            landed = sub.lens[a] + lens[a] + (-s[a] * focus / sub.depth - lens[a]) * cam.distance / focus
            corner = size / 2 - landed / cam.target_pitch - 1.5
            axes.append(trapezoid(np.arange(size)[:, None] - corner, 3.0))
        expected = (axes[0] * excess) @ axes[1].T
        # The second order is s / aperture of the first, times a number of about 1 / 50.
        np.testing.assert_allclose(result[k, l, i, j], expected, rtol=0, atol=1e-3 * np.abs(expected).max())
        largest = max(largest, float(np.abs(expected).max()))
    assert largest > 1e-6
