"""Geometry: windows, sensor patches, order, and cameras that do not fit."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import parse, read, with_changes

from ..examples import GALLERY, THREE, Lenses, camera, scene


def gallery(name: str) -> Camera:
    return derive(read(GALLERY / f"{name}.toml"))


def test_the_arrays_of_the_paper() -> None:
    spans = {
        name: [(lens_type.origin, lens_type.span[0]) for lens_type in gallery(name).types]
        for name in ("tile19", "tile35", "tile41")
    }
    assert spans["tile19"] == [((1, 1), 17), ((0, 0), 19), ((0, 0), 19)]
    assert spans["tile35"] == [((0, 0), 35), ((0, 0), 34), ((0, 0), 35)]
    assert [origin for origin, _ in spans["tile41"]] == [(1, 1), (0, 0), (0, 0)]
    assert [gallery(name).measurements for name in ("tile19", "tile35", "tile41")] == [706, 3013, 3746]


def test_patch_window_and_lens_lie_on_one_line() -> None:
    cam = camera()
    for sub in cam.sub_imagers:
        row, column = (
            float(start + sub.type.ratio * n / 2) for start, n in zip(sub.window, sub.type.pixels, strict=True)
        )
        target = np.array([*cam.position(row, column), cam.distance])
        lens = np.array([*sub.lens, 0.0])
        patch = np.array([*sub.patch, -sub.depth])
        assert np.linalg.norm(np.cross(target - lens, patch - lens)) < 1e-9


def test_order_of_lenses_seen_from_behind() -> None:
    """Columns run towards -x and rows towards -y: lens (k, l) is to the right of (k, l - 1) and below (k - 1, l)."""
    cam = camera()
    subs = {(sub.type.name, sub.k, sub.l): sub for sub in cam.sub_imagers}
    assert subs["A", 0, 1].lens[0] < subs["A", 0, 0].lens[0]
    assert subs["A", 1, 0].lens[1] < subs["A", 0, 0].lens[1]
    assert subs["B", 0, 0].lens[0] < subs["A", 0, 2].lens[0], "types lie side by side"
    xs = [sub.lens[0] for sub in cam.sub_imagers]
    assert max(xs) == pytest.approx(-min(xs)), "the lenses are centred"
    assert list(subs) == sorted(subs)


@given(
    st.integers(20, 60),
    st.fractions(min_value=Fraction(1), max_value=Fraction(7), max_denominator=12),
    st.integers(1, 5),
    st.fractions(min_value=Fraction(0), max_value=Fraction(2), max_denominator=6),
)
def test_windows_lie_on_the_target_and_are_centred(size: int, ratio: Fraction, count: int, step: Fraction) -> None:
    lenses = (((str(1 / ratio)), [count, count], "fit"),)
    data = scene((size, size), lenses).plain()
    data["camera"]["lens"][0]["step"] = str(step)
    data["camera"]["lens_pitch"] = "20 mm"
    cam = derive(parse(data, Path("a.toml")))
    lens_type = cam.types[0]
    first, last = cam.sub_imagers[0].window[0], cam.sub_imagers[-1].window[0] + ratio * lens_type.pixels[0]
    assert first >= 0
    assert last <= size
    assert abs((size - last) - first) < 2, "centred to within a pixel"
    assert ratio * (lens_type.pixels[0] + 1) + (count - 1) * step > size, "no larger sub-image would fit"


@pytest.mark.parametrize(
    ("lenses", "change", "words"),
    [
        ((("1/3", [3, 3], [6, 6]),), [], "at most 5 x 5"),
        ((("1/10", [12, 12], "fit"),), [], "do not fit"),
        (THREE, ["camera.lens_pitch=0.02 mm"], r"lens_pitch.*overlap"),
        ((("1/3", [3000, 3000], [1, 1]),), ["camera.lens.A.step=0"], "at most 16384"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(lenses: Lenses, change: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        derive(with_changes(scene((19, 19), lenses).plain(), Path("a.toml"), change, ()))


def test_gaps_between_windows_are_not_seen() -> None:
    data = scene((19, 19), (("1/3", [2, 2], [3, 3]),)).plain()
    data["camera"]["lens"][0]["step"] = 10
    cam = derive(parse(data, Path("a.toml")))
    assert cam.types_seeing().sum() == (2 * 9) ** 2
