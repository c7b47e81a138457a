"""Noise of recorded frames against simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ommatid.scenes.hardware.point_sources import CHANCE, background, photon_transfer, rounding

from ..examples import camera

GAIN, READ = 0.02, 0.3  # units of f: of one electron, and of the read noise


def test_photon_transfer_finds_dark_and_photon_noise() -> None:
    """For Poisson counts with normal noise, to five standard errors of the sample variances that decide each."""
    rng = np.random.default_rng(0)
    light = np.repeat([0.0, 1.0, 5.0, 40.0], 500)
    readings = rng.poisson(light / GAIN, (6, light.size)) * GAIN + rng.normal(0, READ, (6, light.size))
    mean, variance = readings.mean(axis=0), readings.var(axis=0, ddof=1)
    dark, photons = photon_transfer(mean, variance, np.full(light.size, 6))
    assert dark == pytest.approx(READ**2, rel=5 * (2 / 5 / 500) ** 0.5)
    assert photons == pytest.approx(GAIN, rel=5 * (2 / 5 / 1000) ** 0.5)


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.2, 0.4])
def test_rounding_is_an_upper_bound_within_a_factor_of_three(deviation: float) -> None:
    """The exact mean of rounded normal readings, averaged over positions between two steps by the trapezoidal rule."""
    steps = np.arange(-8, 9)
    positions = np.linspace(-0.5, 0.5, 201)[:, None]
    if deviation == 0:
        mean, square = np.rint(positions[:, 0]), np.rint(positions[:, 0]) ** 2
    else:
        above, below = (stats.norm.cdf((steps + half - positions) / deviation) for half in (0.5, -0.5))
        mean, square = (above - below) @ steps, (above - below) @ steps**2
    variance = np.trapezoid((mean - positions[:, 0]) ** 2, positions[:, 0])
    of_readings = np.trapezoid(square - mean**2, positions[:, 0])
    bound = float(rounding(np.array([of_readings]), np.ones(1))[0])
    step_error = 3 / 200  # of the trapezoidal rule without noise, where the integrand jumps
    assert variance == pytest.approx(bound, rel=step_error) if deviation == 0 else bound / 3 < variance <= bound


@pytest.mark.parametrize("sources", [1, 2])
def test_background_takes_noise_for_light_at_the_stated_rate(sources: int) -> None:
    """Of sources lit alone, whose neighbours are tested together, and of several, whose readings are tested by one."""
    rng, small = np.random.default_rng(1), camera((12, 12), (("1/3", [2, 2], [3, 3]),))
    lone = np.arange(small.unknowns) if sources == 1 else np.full(small.unknowns, -1)
    near = np.zeros((small.unknowns, small.measurements), dtype=bool)
    found = [background(small, noise, near, lone, 8) for noise in rng.normal(0, 1, (100, *near.shape))]
    false_alarms = sum(bool(each.far.any()) or each.stray > 0 for each in found)
    assert stats.binomtest(false_alarms, 100, CHANCE).pvalue > 0.001
    assert np.mean([each.variance.mean() for each in found]) == pytest.approx(1, abs=5 * (2 / 100 / near.size) ** 0.5)
