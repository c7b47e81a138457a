"""Point-spread functions of made-up pupils, of the gallery's lenses and of an asphere, against integrals.

Radii are in units of the wavelength times the f-number on the target's side, aberrations in waves over the unit disk.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import ceil, pi
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from scipy import integrate
from scipy.special import j0, j1

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.optics.field import Optics, ThinOptics, optics_of
from ommatid.scenes.optics.point_spread import density, point_spread, relative_intensity, strehl_ratio
from ommatid.scenes.optics.wavefront import GRID_REACH, Wavefront, node_counts, polar_nodes, thin_wavefront
from ommatid.scenes.scene import parse, read

from ..examples import GALLERY
from ..wave_optics import aperture_of, relative_light
from .zemax_lenses import zmx

WAVELENGTH = 5.5e-4
HALF = 0.1  # sine of the half angle of the cone of light
UNIT = WAVELENGTH / (2 * HALF)
FREQUENCIES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])  # of the cut-off
Aberration = Callable[[np.ndarray, np.ndarray], np.ndarray]


def pupil(waves: Aberration, slope: float, reach: float = GRID_REACH) -> Wavefront:
    """Return the wave of a round pupil with an aberration of these waves at (radius, angle).

    slope : the largest change of the aberration over the radius, waves per radius
    """
    spot = 2 * slope * UNIT
    radius, angle, area = polar_nodes(node_counts(HALF / WAVELENGTH, spot, spot + reach * UNIT))
    turn = np.ones_like(radius) * angle
    share = (np.ones_like(turn) * area).ravel()
    unit = (radius * np.stack([np.cos(angle), np.sin(angle)])).reshape(2, -1)
    path = waves((radius + 0 * turn).ravel(), turn.ravel()) * WAVELENGTH
    return Wavefront(
        WAVELENGTH, HALF * unit, path, share / np.pi, share * HALF**2, spot * unit, (0.0, 0.0), 1.0, radius.max()
    )


def defocused(waves: float) -> Wavefront:
    return pupil(lambda radius, _: waves * radius**2, 2 * waves)


def by_autocorrelation(waves: Callable[[np.ndarray], np.ndarray], frequency: float, count: int = 400) -> float:
    """Return the MTF of a round pupil with waves(radius), at a frequency in units of the cut-off.

    The overlap of two unit disks, 2 `frequency` apart, row by row of y, by Gauss's quadrature along both.
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    top = np.sqrt(1 - frequency**2)
    turn = np.arcsin(top) * nodes  # y = sin(turn) takes the square root at the ends out of the integrand
    y = np.sin(turn)
    half = np.sqrt(1 - y**2) - frequency
    x = half[:, None] * nodes
    phase = waves(np.hypot(x + frequency, y[:, None])) - waves(np.hypot(x - frequency, y[:, None]))
    rows = half * (np.exp(2j * np.pi * phase) @ weights)
    return float(abs(np.sum(rows * np.cos(turn) * weights) * np.arcsin(top)) / np.pi)


def encircled_energy(wave: Wavefront, radius: float) -> float:
    """Return the share of the light within a distance of the centre. The wave's nodes must serve that distance."""
    rings = 16 + ceil(4 * radius / wave.resolution)
    turns = 32 + ceil(14 * radius / wave.resolution)
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    distance, angle = radius * (nodes + 1) / 2, 2 * pi * np.arange(turns) / turns
    x, y = np.outer(distance, np.cos(angle)), np.outer(distance, np.sin(angle))
    mean = density(wave, x.ravel(), y.ravel()).reshape(rings, turns).mean(axis=1)
    return float(2 * pi * (mean * distance) @ weights * radius / 2)


def test_an_open_pupil_is_airys() -> None:
    wave = pupil(lambda radius, _: 0 * radius, 0)
    for radius in (0.5, 1.22, 3.0, 10.0, 30.0):
        v = np.pi * radius
        assert encircled_energy(wave, radius * UNIT) == pytest.approx(1 - j0(v) ** 2 - j1(v) ** 2, abs=1e-6)
    spread = point_spread(wave)
    assert 0.995 <= spread.inside < 1
    mtf = 2 / np.pi * (np.arccos(FREQUENCIES) - FREQUENCIES * np.sqrt(1 - FREQUENCIES**2))
    for turn in (0.0, 0.7):
        at = FREQUENCIES[:, None] / UNIT * [np.cos(turn), np.sin(turn)]
        np.testing.assert_allclose(spread.transfer(at), mtf, atol=1e-3)


@pytest.mark.parametrize(("waves", "power"), [(0.1, 2), (0.3, 2), (1.0, 2), (3.0, 2), (1.0, 4), (3.0, 4)])
def test_defocus_and_primary_spherical_aberration(waves: float, power: int) -> None:
    """Middle, MTF (Hopkins 1955, by direct autocorrelation) and encircled energy against integrals along the radius."""
    wave = pupil(lambda radius, _: waves * radius**power, power * waves)
    middle = integrate.quad_vec(lambda square: np.exp(2j * np.pi * waves * square ** (power / 2)), 0, 1)[0]
    found = relative_intensity(wave, np.zeros(1), np.zeros(1))[0]
    assert found == pytest.approx(abs(middle) ** 2, abs=1e-6)
    along = (FREQUENCIES / UNIT, 0 * FREQUENCIES)
    at = np.stack(along if power == 2 else along[::-1], axis=1)
    expected = [by_autocorrelation(lambda radius: waves * radius**power, frequency) for frequency in FREQUENCIES]
    np.testing.assert_allclose(point_spread(wave).transfer(at), expected, atol=1e-3)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    rho = (nodes + 1) / 2
    radii = rho * 3.0  # as far as the encircled energy goes
    bessel = j0(np.pi * np.outer(radii, rho))
    field = bessel @ (weights / 2 * rho * np.exp(2j * np.pi * waves * rho**power))
    # Over the whole plane |2 integral|^2 pi / 4 integrates to 1 in these units (Airy's middle is pi / 4 per unit^2).
    encircled = np.sum(np.abs(2 * field) ** 2 * np.pi / 4 * 2 * np.pi * radii * weights / 2) * 3.0
    assert encircled_energy(wave, 3.0 * UNIT) == pytest.approx(encircled, abs=1e-3)


def test_many_waves_of_defocus_are_the_disk_of_rays() -> None:
    """The encircled energy of a uniform disk, away from the rings at its edge."""
    wave = defocused(30.0)
    for share in (0.3, 0.5, 0.7):
        assert encircled_energy(wave, share * wave.spot_radius) == pytest.approx(share**2, abs=1e-3)


def test_more_waves_than_can_be_computed_are_refused() -> None:
    with pytest.raises(InputError, match="oscillates"):
        defocused(1000.0)
    with pytest.raises(InputError, match="finest detail"):
        point_spread(defocused(0.1), (UNIT / 4, 1000 * UNIT))


def test_the_wave_of_a_thin_lens() -> None:
    """Focused beyond the target: W20 = D^2 / 8 (1 / Z - 1 / F) waves, and light falls with cos^4 to the rim."""
    wave = thin_wavefront(0.4, 3.0, 0.0, 1000.0, 1250.0, WAVELENGTH)
    waves = 0.4**2 / 8 * (1 / 1000 - 1 / 1250) / WAVELENGTH
    assert strehl_ratio(wave) == pytest.approx(np.sinc(waves) ** 2, abs=1e-4)
    assert wave.resolution == pytest.approx(WAVELENGTH * 1000 / 0.4, rel=1e-6)
    assert wave.brightness == pytest.approx(np.pi * np.sin(np.arctan(0.2 / 3)) ** 2, rel=1e-9)
    found = point_spread(wave).transfer(np.stack([FREQUENCIES / wave.resolution, 0 * FREQUENCIES], axis=1))
    expected = [by_autocorrelation(lambda radius: waves * radius**2, frequency) for frequency in FREQUENCIES]
    np.testing.assert_allclose(found, expected, atol=1e-3)


def thin_field(waves: float) -> ThinOptics:
    aperture, depth, distance = 1.0, 10.0, 100.0
    focus = 1 / (1 / distance + 8 * waves * WAVELENGTH / aperture**2)
    return ThinOptics(depth, distance, 0.1, WAVELENGTH, 9.0, (aperture, 0.0), depth / aperture, aperture, focus)


def test_thin_lenses_have_fringes_up_to_a_hundred_waves_of_defocus() -> None:
    """Pixels of a few finest details see them: without, entries of H are wrong by a third."""
    assert [thin_field(waves).rays_suffice for waves in (26.0, 99.0, 101.0)] == [False, False, True]
    field = thin_field(26.0)
    wave, cell = field.lit_wave(0.0), field.grid[0]
    spread = point_spread(wave, field.grid).values
    v = pi / wave.resolution * cell * np.arange(1, len(spread) // 2, dtype=np.float64)
    nodes, weights = np.polynomial.legendre.leggauss(2000)
    u, slope = (nodes + 1) / 2, 0.05**2
    pupil_field = u / (1 + slope * u**2) * np.exp(2j * pi * 26.0 * u**2) * weights / 2
    # By Parseval's theorem the integral of v |U|^2 is 1 / (2 (1 + slope)).
    expected = np.square(np.abs(j0(np.outer(v, u)) @ pupil_field)) * (1 + slope) * v[0] ** 2 / pi
    found = spread[len(spread) // 2, len(spread) // 2 + 1 :][: v.size]
    np.testing.assert_allclose(found, expected, atol=1e-3 * expected.max())


GREEN = 5.5e-4
BLUE = 4.5e-4

SMALL_PIXELS = ["camera.pixel_pitch=6 um", "camera.lens_pitch=0.5 mm"]  # lenses of focal lengths of 1.2 to 2 mm


@cache
def field(name: str, wavelength: float) -> Optics:
    scene = read(GALLERY / f"{'planoconvex' if name == ASPHERE else name}.toml", SMALL_PIXELS)
    if name == ASPHERE:
        data = scene.plain()
        data["camera"]["lens_pitch"] = "2 mm"
        for table in data["camera"]["lens"]:
            table["surfaces"] = asphere()
        scene = parse(data, Path("test.toml"))
    camera = derive(scene)
    return optics_of(camera, camera.types[0], wavelength)


def asphere() -> list[dict[str, Any]]:
    """Return the two aspheres of a file of Zemax, stopped to f/3.9, whose cone of light the sums neglect by 1e-4."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "lens.zmx"
        path.write_text(zmx(ASPHERE), encoding="utf-16")
        surfaces = [surface.model_dump(mode="json", exclude_none=True) for surface in read_lens(path)]
    return [surfaces[0] | {"semi_diameter": "2 mm"}, *surfaces[1:]]


ASPHERE = "asphere"
CASES = [(name, wavelength) for name in ("planoconvex", "doublet", ASPHERE) for wavelength in (GREEN, BLUE)]


EVERY = pytest.mark.parametrize(
    ("name", "wavelength", "share"),
    [(*case, 1.0) for case in CASES] + [pytest.param(*case, 0.0, marks=pytest.mark.slow) for case in CASES],
)


@EVERY
def test_along_a_line(name: str, wavelength: float, share: float) -> None:
    """The light that the farthest sensor point, or the middle, gets from points of the target in the plane of the axis.

    In blue the glass defocuses both lenses.
    """
    lens = field(name, wavelength)
    height = share * lens.field
    wave, aperture = lens.lit_wave(height), aperture_of(lens.prescription, lens.depth, height)
    offsets = wave.resolution * np.linspace(-4.0, 4.0, 161)
    found = relative_light(lens.prescription, lens.distance, aperture, wave.centre[1] + offsets, wavelength)
    assert strehl_ratio(wave) == pytest.approx(found.max(), abs=1e-3)
    np.testing.assert_allclose(relative_intensity(wave, 0 * offsets, offsets), found, atol=1e-3)


@pytest.mark.slow
@EVERY
def test_over_the_target(name: str, wavelength: float, share: float) -> None:
    """Encircled energy, and MTF at five frequencies of three directions, of the light on a grid over the target."""
    lens = field(name, wavelength)
    height = share * lens.field
    wave, aperture = lens.lit_wave(height), aperture_of(lens.prescription, lens.depth, height)
    spread = point_spread(wave, (wave.resolution / 4, 5 * wave.resolution))
    heights, asides = (middle + spread.offsets for middle in wave.centre[::-1])
    columns = [relative_light(lens.prescription, lens.distance, aperture, heights, wavelength, x) for x in asides]
    own = np.stack(columns, axis=1)
    own *= spread.inside / own.sum()
    assert np.abs(spread.values - own).max() < 1e-3 * own.max()
    radius = np.hypot(spread.offsets[:, None], spread.offsets) / wave.resolution
    for within in (radius < 0.61, radius < 1.22, radius < 2.5):
        assert spread.values[within].sum() == pytest.approx(own[within].sum(), abs=1e-3)
    for turn in (0.0, 0.25 * np.pi, 0.5 * np.pi):
        at = np.outer(FREQUENCIES / wave.resolution, [np.cos(turn), np.sin(turn)])
        phases = 2j * np.pi * (at[:, 0, None, None] * spread.offsets + at[:, 1, None, None] * spread.offsets[:, None])
        transfers = np.abs((own * np.exp(phases)).sum(axis=(1, 2)))
        np.testing.assert_allclose(spread.transfer(at), transfers, atol=1e-3)
