"""The ideal sensor: noise of the requested variance from independent streams, and quantisation as noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ommatid.scenes.tables.sensor import NoiseTable
from ommatid.simulate.sensors import expose, generators, quantise

from ..examples import THREE, camera


def test_noise_has_the_requested_variance() -> None:
    rng = np.random.default_rng(0)
    size = 40_000
    noise = expose(np.full(size, 100.0), NoiseTable(variance=0.25), [rng], [slice(0, size)]) - 100
    bounds = stats.chi2.ppf([0.005, 0.995], size - 1) / (size - 1)
    assert bounds[0] < noise.var(ddof=1) / 0.25 < bounds[1]
    assert abs(noise.mean()) < 2.6 * (0.25 / size) ** 0.5


@pytest.mark.parametrize("bits", [4, 8, 12])
def test_quantisation_acts_as_noise_of_a_twelfth_of_the_squared_step(bits: int) -> None:
    values = np.random.default_rng(1).uniform(0, 255, 100_000)
    step = 256 / 2**bits
    error = quantise(values, NoiseTable(bits=bits).level) - values
    assert np.abs(error).max() <= step / 2 * (1 + 1e-12)
    # Four standard errors: the square of a uniform deviate has the relative variance 4/5.
    assert error.var() == pytest.approx(step**2 / 12, rel=4 * (0.8 / error.size) ** 0.5)
    assert NoiseTable(bits=bits).quantisation_variance == pytest.approx(step**2 / 12)
    levels = np.unique(quantise(values, step) / step)
    assert (levels == np.round(levels)).all()


def test_no_noise_changes_nothing() -> None:
    light = np.linspace(0, 255, 50)
    np.testing.assert_array_equal(expose(light, NoiseTable(), [], []), light)


def test_a_sub_imagers_noise_does_not_depend_on_its_neighbours() -> None:
    three, one = camera(), camera(lenses=THREE[:1])
    noise = NoiseTable(variance=1.0)
    whole = expose(np.zeros(three.measurements), noise, generators(three, 5), three.slices())
    alone = expose(np.zeros(one.measurements), noise, generators(one, 5), one.slices())
    np.testing.assert_array_equal(whole[: one.measurements], alone)
    others = expose(np.zeros(one.measurements), noise, generators(one, 6), one.slices())
    assert abs(np.corrcoef(alone, others)[0, 1]) < 4 / 225**0.5
