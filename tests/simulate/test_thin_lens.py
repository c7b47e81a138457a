"""Rays from sensor points through ideal lenses: directions and weights in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.scenes.pose import corner_offset, pose_of
from ommatid.simulate.renderer import lens as thin_lens
from ommatid.simulate.renderer.variant import activate

from ..examples import camera, mean_weights, needs, with_optics
from .world_files import FAST

PLACES = st.floats(-1, 1)


@given(st.integers(0, 49), st.floats(0, 1), st.floats(0, 1))
def test_a_ray_meets_the_target_at_the_magnified_position(number: int, down: float, across: float) -> None:
    """From sensor through pinhole to target: pixel (i + u, j + v) looks at window + m (i + u, j + v)."""
    one = camera()
    sub = one.sub_imagers[number]
    stand, (u, v) = pose_of(sub), corner_offset(one, sub)
    i, j = down * sub.type.pixels[0], across * sub.type.pixels[1]
    x, y, z = stand.middle + stand.axes @ [u + j * one.pixel_pitch, v + i * one.pixel_pitch]
    slopes = np.array(thin_lens.through_centre(x, y, -z))
    m = float(sub.type.ratio)
    expected = one.position(float(sub.window[0]) + m * i, float(sub.window[1]) + m * j)
    assert np.array(sub.lens) + slopes * one.distance == pytest.approx(expected, abs=1e-9)


@given(PLACES, PLACES, PLACES)
def test_the_thin_lens_equation(slope: float, one: float, other: float) -> None:
    """1/f = 1/s + 1/d: two rays of one sensor point, d behind a lens of focal length f, meet s before it."""
    f, d = 25.0, 30.0  # so s = 150
    ways = [thin_lens.through_thin_lens(slope, place, d, f) for place in (one, other)]
    assert one + 150.0 * ways[0] == pytest.approx(other + 150.0 * ways[1], abs=1e-9)
    assert one + 150.0 * ways[0] == pytest.approx(150.0 * slope, abs=1e-9), "and with the ray through the centre"


def test_light_through_a_wide_lens_onto_its_axis() -> None:
    """Its projected solid angle is pi sin^2 of half the cone, whatever the width (Boyd 1983)."""
    a, d = 1.5, 2.0
    nodes, weights = np.polynomial.legendre.leggauss(40)
    radius = a * (nodes + 1) / 2
    mean = float(np.sum(weights * radius * thin_lens.falloff(0.0, 0.0, radius, 0.0, d))) * a / 2 / (a**2 / 2)
    assert mean == pytest.approx(d**2 / (d**2 + a**2), rel=1e-9)


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
