"""Diffraction of a defocused circular pupil against closed forms, Hopkins' transfer function, and direct sums."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate, special

from ommatid.scenes.optics.diffraction import TAIL, Pattern, pattern

from ..printed_figures import check_figures

Numbers = NDArray[np.float64]

WAVES = [0.0, 0.1, 0.21, 0.5, 1.0, 2.0, 3.0, 20.0]
FREQUENCIES = [0.1, 0.3, 0.5, 0.7, 0.9]  # of the cut-off


def hopkins(q: float, waves: float) -> float:
    """Transfer function of a defocused circular pupil (H. H. Hopkins, Proc. R. Soc. A 231, 91 (1955), Eq. 16)."""
    chord, _ = integrate.quad(  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        lambda x: np.cos(8 * np.pi * waves * q * x) * np.sqrt(1 - (x + q) ** 2), 0, 1 - q, limit=500
    )
    return float(4 / np.pi * chord)


def modulation(psf: Pattern, q: float) -> float:
    v = np.linspace(0.0, psf.end, 20001)
    return float(integrate.simpson(psf.spread(v) * special.j0(2 * q * v), x=v))


@pytest.mark.parametrize("waves", [0.0, 0.085, 0.21, 0.33, 0.5, 0.9, 1.0, 2.0])
def test_the_strehl_ratio_of_defocus_is_its_squared_sinc(waves: float) -> None:
    v = np.array([1e-4])
    assert 2 * pattern(waves).spread(v)[0] / v[0] == pytest.approx(np.sinc(waves) ** 2, abs=1e-8)


def test_the_strehl_ratio_of_the_documentation() -> None:
    v = np.array([1e-4])
    strehl = 2 * pattern(0.21).spread(v)[0] / v[0]
    check_figures("diffraction.md", "with 0.21 waves of defocus, the Strehl ratio is {};", strehl)


@pytest.mark.parametrize("waves", WAVES)
def test_modulation_at_five_frequencies_is_hopkins(waves: float) -> None:
    for q in FREQUENCIES:
        assert modulation(pattern(waves), q) == pytest.approx(hopkins(q, waves), abs=1e-3)


def test_the_pattern_in_focus_is_airy_s() -> None:
    psf = pattern(0.0)
    v = np.linspace(0.1, psf.end, 1000)
    np.testing.assert_allclose(psf.spread(v), 2 * special.j1(v) ** 2 / v, atol=1e-6)
    np.testing.assert_allclose(psf.within(v), 1 - special.j0(v) ** 2 - special.j1(v) ** 2, atol=1e-6)
    assert psf.encircled == pytest.approx(1 - TAIL, abs=3e-5)


@pytest.mark.parametrize("waves", WAVES)
def test_encircled_energy_follows_from_the_transfer_function(waves: float) -> None:
    """The share within v is 2 v times the integral of the transfer function and J1(2 q v) over q (Parseval)."""
    psf = pattern(waves)
    x, w = np.polynomial.legendre.leggauss(400)
    q = np.sin(np.pi / 4 * (1 + x)) ** 2
    weights = np.pi / 4 * w * np.sin(np.pi / 2 * (1 + x))
    otf = np.array([hopkins(value, waves) for value in q])
    for share in (0.05, 0.2, 0.5, 0.8):
        v = share * psf.end
        expected = 2 * v * weights @ (otf * special.j1(2 * q * v))
        assert psf.within(v) == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
def test_many_waves_are_a_disk_of_rays() -> None:
    psf, rim = pattern(100.0), 4 * np.pi * 100.0
    shares = np.array([0.2, 0.5, 0.8])
    np.testing.assert_allclose(psf.within(np.sqrt(shares) * rim), shares, atol=1e-2)
    assert psf.within(1.05 * rim) > 0.98


@pytest.mark.parametrize("waves", [0.0, 0.05, 0.3, 2.0])
@pytest.mark.parametrize("weight", [0.0, 0.03])
def test_a_pupil_with_a_bright_side(waves: float, weight: float) -> None:
    """Against the field of 300 x 96 points of a pupil whose amplitude is larger on one side, squared."""
    psf, s = pattern(waves, weight), 1e-4
    nodes, shares = np.polynomial.legendre.leggauss(300)
    u, turn = (1 + nodes[:, None]) / 2, 2 * np.pi * np.arange(96) / 96
    element = shares[:, None] / 2 * u * 2 * np.pi / 96 * np.exp(2j * np.pi * waves * u**2) / (1 + weight * u**2)

    def light(v: float, angle: float, side: float) -> float:
        tilted = element * (1 + side * u * np.cos(turn) / (1 + weight * u**2))
        # A point of a pupil that is defocused outwards sends its ray outwards.
        return float(np.abs((tilted * np.exp(-1j * v * u * np.cos(turn - angle))).sum()) ** 2)

    for v in (0.7, 2.5, 6.0):
        middle = light(v, 0.4, 0.0)
        whole = 2 * np.pi**2 * 2 / (2 * (1 + weight))  # by Parseval, of v dv
        assert psf.spread(np.array([v]))[0] == pytest.approx(v * middle / whole, rel=1e-6)
        change = (light(v, 0.4, s) - light(v, 0.4, -s)) / (2 * s)
        assert psf.slant(np.array([v]))[0] * np.cos(0.4) == pytest.approx(v * change / whole, abs=1e-6)


def test_quantiles_encircle_their_shares() -> None:
    psf, share = pattern(0.3), np.linspace(0, 1, 101)
    radii = psf.quantiles(100)
    np.testing.assert_allclose(psf.within(radii) / psf.encircled, share**2, atol=2e-3)
