"""Rays from sensor points through ideal lenses: directions and weights in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ommatid.simulate.renderer.variant import activate

from ..examples import mean_weights, needs, with_optics
from .world_files import FAST


def test_rendered_light_follows_the_solid_angle() -> None:
    """Every pixel's mean weight against the solid angle of the lens in closed form: within the noise and 1 per cent."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer.renderer import Renderer

    sizes = {"pixel_pitch": "80 um", "lens_pitch": "9 mm"}
    target = {"pixel_pitch": "20 mm"}  # so that the corner is seen at 45 degrees and more
    _, one = with_optics({"aperture": "40 um"}, sizes, (("1/4", [1, 1], [25, 25]),), (100, 100), target=target)
    found = mean_weights(Renderer(one, "llvm_ad_mono"), "A", 256).reshape(25, 25)
    away = (np.arange(25) - 12) * one.pixel_pitch / one.depth(one.types[0])
    cosine = 1 / np.sqrt(1 + away[:, None] ** 2 + away[None, :] ** 2)
    assert cosine.min() < 0.6
    np.testing.assert_allclose(found, cosine**4, rtol=0.01)


@pytest.mark.parametrize("ends", [(30.0, 40.0), (19.9, 25.0)])
def test_patterns_of_many_waves_are_as_wide_as_the_disk_of_rays(ends: tuple[float, float]) -> None:
    needs(FAST)
    activate(FAST)
    import mitsuba as mi

    from ommatid.simulate.renderer.diffracting_lens import BandTable

    waves, share = np.linspace(*ends, 5), 0.25
    v, _ = BandTable(np.array(ends), 0.0, 64).at(mi.Float(waves), mi.Float(share), all_light=False)
    assert np.array(v) == pytest.approx(4 * np.pi * waves * np.sqrt(share), rel=0.03)
