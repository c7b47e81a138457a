"""Point-spread functions of the gallery's lenses and of an asphere, against an independent script's."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from ommatid.scenes.camera import derive
from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.optics.field import Optics, optics_of
from ommatid.scenes.optics.point_spread import point_spread, relative_intensity, strehl_ratio
from ommatid.scenes.scene import parse, read

from ..examples import GALLERY
from ..wave_optics import aberration, aperture_of, relative_light
from .test_point_spread import FREQUENCIES, by_autocorrelation, encircled_energy
from .zemax_lenses import zmx

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


@pytest.mark.slow
@pytest.mark.parametrize(("name", "wavelength"), CASES)
def test_over_the_target_at_the_corner(name: str, wavelength: float) -> None:
    """Encircled energy, and MTF at five frequencies of three directions, of the light on a grid over the target."""
    lens = field(name, wavelength)
    wave, aperture = lens.lit_wave(lens.field), aperture_of(lens.prescription, lens.depth, lens.field)
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
