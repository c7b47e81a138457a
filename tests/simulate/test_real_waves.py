"""Point-spread functions of the gallery's lenses, against an independent script's."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.simulate.lenses.field import LensField, field_of
from ommatid.simulate.lenses.point_spread import point_spread, relative_intensity, strehl_ratio

from ..examples import GALLERY
from ..wave_optics import aberration, aperture_of, relative_light
from .test_point_spread import FREQUENCIES, by_autocorrelation, encircled_energy

GREEN = 5.5e-4
BLUE = 4.5e-4

SMALL_PIXELS = ["camera.pixel_pitch=6 um", "camera.lens_pitch=0.5 mm"]  # lenses of focal lengths of 1.2 to 2 mm


@cache
def field(name: str, wavelength: float) -> LensField:
    camera = Setup.from_scene(read(GALLERY / f"{name}.toml", SMALL_PIXELS)).camera
    return field_of(camera, camera.types[0], wavelength)


CASES = [("planoconvex", GREEN), ("planoconvex", BLUE), ("doublet", GREEN), ("doublet", BLUE)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "wavelength"), CASES)
def test_on_the_axis(name: str, wavelength: float) -> None:
    """Strehl ratio, encircled energy and MTF of the sensor's middle. In blue the glass defocuses both lenses."""
    lens = field(name, wavelength)
    wave, aperture = lens.lit_wave(0.0), aperture_of(lens.prescription, lens.depth, 0.0)
    middle = relative_light(lens.prescription, lens.distance, aperture, np.zeros(1), wavelength)
    assert strehl_ratio(wave) == pytest.approx(middle[0], abs=1e-3)
    nodes, weights = np.polynomial.legendre.leggauss(32)
    radii = 4 * wave.resolution * (nodes + 1) / 2
    profile = relative_light(lens.prescription, lens.distance, aperture, radii, wavelength)
    np.testing.assert_allclose(relative_intensity(wave, 0 * radii, radii), profile, atol=1e-3)
    within = np.polynomial.legendre.Legendre.fit(nodes, profile * radii, 31, domain=[-1, 1]).integ(lbnd=-1)
    for share in (0.2, 0.4, 0.6):
        found = encircled_energy(wave, share * 4 * wave.resolution) / encircled_energy(wave, 4 * wave.resolution)
        assert found == pytest.approx(within(2 * share - 1) / (profile * radii @ weights), abs=1e-3)
    waves = aberration(lens.prescription, lens.distance, aperture, wavelength)
    at = np.stack([FREQUENCIES / wave.resolution, 0 * FREQUENCIES], axis=1)
    transfers = [by_autocorrelation(lambda radius: waves(radius**2), frequency) for frequency in FREQUENCIES]
    np.testing.assert_allclose(point_spread(wave).transfer(at), transfers, atol=1e-3)


@pytest.mark.parametrize(("name", "wavelength"), CASES)
def test_at_the_corner(name: str, wavelength: float) -> None:
    """The light that the farthest sensor point gets from points of the target, in the plane through the axis."""
    lens = field(name, wavelength)
    wave, aperture = lens.lit_wave(lens.field), aperture_of(lens.prescription, lens.depth, lens.field)
    offsets = wave.resolution * np.linspace(-1.5, 1.5, 61)
    found = relative_light(lens.prescription, lens.distance, aperture, wave.centre[1] + offsets, wavelength)
    assert strehl_ratio(wave) == pytest.approx(found.max(), abs=1e-3)
    np.testing.assert_allclose(relative_intensity(wave, 0 * offsets, offsets), found, atol=1e-3)
