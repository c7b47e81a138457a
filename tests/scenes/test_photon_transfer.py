"""Noise of recorded frames against simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ommatid.scenes.hardware.point_sources import background, photon_transfer, rounding

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
def test_rounding_is_an_upper_bound_within_a_factor_of_two(deviation: float) -> None:
    """The exact mean of rounded normal readings, averaged over positions between two steps by the trapezoidal rule."""
    steps = np.arange(-8, 9)
    positions = np.linspace(-0.5, 0.5, 201)[:, None]
    if deviation == 0:
        mean = np.rint(positions[:, 0])
    else:
        above, below = (stats.norm.cdf((steps + half - positions) / deviation) for half in (0.5, -0.5))
        mean = (above - below) @ steps
    variance = np.trapezoid((mean - positions[:, 0]) ** 2, positions[:, 0])
    bound = float(rounding(np.array([deviation**2]), np.ones(1))[0])
    step_error = 3 / 200  # of the trapezoidal rule without noise, where the integrand jumps
    assert variance == pytest.approx(bound, rel=step_error) if deviation == 0 else 0.5 * bound < variance <= bound


def test_background_takes_noise_for_light_at_the_stated_rate() -> None:
    rng = np.random.default_rng(1)
    false_alarms = [(noise > background(noise, 0.05)[1]).any() for noise in rng.normal(0, 1, (200, 10000))]
    assert stats.binomtest(int(np.sum(false_alarms)), 200, 0.05).pvalue > 0.001
    assert background(np.append(rng.normal(0, 1, 200), 30.0), 0.01)[0] == pytest.approx(1, abs=5 * (2 / 200) ** 0.5)
