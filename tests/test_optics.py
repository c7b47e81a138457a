"""Rays from sensor pixels through lenses: where they meet the target, in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulate import optics

from .examples import camera


@given(st.integers(0, 49), st.floats(0, 1), st.floats(0, 1))
def test_a_ray_meets_the_target_where_the_magnification_says(number: int, down: float, across: float) -> None:
    """From sensor through pinhole to target: pixel (i + u, j + v) looks at window + m (i + u, j + v)."""
    one = camera()
    sub = one.sub_imagers[number]
    i, j = down * sub.type.pixels[0], across * sub.type.pixels[1]
    x, y = optics.pixel_corner(one, sub, i, j)
    direction = np.array(optics.through_pinhole(x, y, sub.depth))
    hit = np.array([*sub.lens, 0.0]) + direction * one.distance / direction[2]
    m = float(sub.type.ratio)
    expected = one.position(float(sub.window[0]) + m * i, float(sub.window[1]) + m * j)
    assert hit[2] == pytest.approx(one.distance)
    assert hit[:2] == pytest.approx(expected, abs=1e-9)


def test_the_image_on_the_sensor_is_upside_down() -> None:
    one = camera()
    sub = one.sub_imagers[4]
    left, top = optics.pixel_corner(one, sub, 0, 0)
    right, bottom = optics.pixel_corner(one, sub, *sub.type.pixels)
    assert top < bottom, "the top of the target lands at the smallest y"
    assert left < right, "and its left, at the largest x, at the smallest x"
