"""Geometry: windows, sensor patches, order, and what does not fit."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import parse, read

from ..examples import GALLERY, THREE, camera, scene


def gallery(name: str) -> Camera:
    return derive(read(GALLERY / f"{name}.toml"))


def test_the_papers_arrays() -> None:
    spans = {
        name: [(kind.origin, kind.span[0]) for kind in gallery(name).types] for name in ("tile19", "tile35", "tile41")
    }
    assert spans["tile19"] == [((1, 1), 17), ((0, 0), 19), ((0, 0), 19)]
    assert spans["tile35"] == [((0, 0), 35), ((0, 0), 34), ((0, 0), 35)]
    assert [origin for origin, _ in spans["tile41"]] == [(1, 1), (0, 0), (0, 0)]
    assert [gallery(name).measurements for name in ("tile19", "tile35", "tile41")] == [706, 3013, 3746]


def test_fit_takes_the_largest_sub_image() -> None:
    assert [kind.pixels for kind in gallery("photo").types] == [(79, 79), (47, 47), (59, 59)]
    assert (gallery("photo").types_seeing() == 3).all(), "59 = 60 - 1 leaves no pixel to fewer types"
    assert gallery("single").types[0].pixels == (59, 59)


def test_thin_lens_equation_and_magnification() -> None:
    one = camera()
    for kind, m in zip(one.types, (3, 5, 4), strict=True):
        assert one.depth(kind) / one.distance == pytest.approx(one.pixel_pitch / (m * one.target_pitch))
        focal = one.focal_length(kind)
        assert 1 / focal == pytest.approx(1 / one.distance + 1 / one.depth(kind))
        assert focal < one.depth(kind)


def test_patch_window_and_lens_lie_on_one_line() -> None:
    one = camera()
    for sub in one.sub_imagers:
        row, column = (
            float(start + sub.type.ratio * n / 2) for start, n in zip(sub.window, sub.type.pixels, strict=True)
        )
        target = np.array([*one.position(row, column), one.distance])
        lens = np.array([*sub.lens, 0.0])
        patch = np.array([*sub.patch, -sub.depth])
        assert np.linalg.norm(np.cross(target - lens, patch - lens)) < 1e-9


def test_order_of_lenses_seen_from_behind() -> None:
    """Columns run towards -x and rows towards -y: lens (k, l) stands right of (k, l - 1) and below (k - 1, l)."""
    one = camera()
    subs = {(sub.type.name, sub.k, sub.l): sub for sub in one.sub_imagers}
    assert subs["A", 0, 1].lens[0] < subs["A", 0, 0].lens[0]
    assert subs["A", 1, 0].lens[1] < subs["A", 0, 0].lens[1]
    assert subs["B", 0, 0].lens[0] < subs["A", 0, 2].lens[0], "types side by side"
    xs = [sub.lens[0] for sub in one.sub_imagers]
    assert max(xs) == pytest.approx(-min(xs)), "the whole is centred"
    assert list(subs) == sorted(subs)


def test_slices_follow_each_other() -> None:
    one = camera()
    slices = one.slices()
    assert slices[0].start == 0
    assert slices[-1].stop == one.measurements
    assert all(before.stop == after.start for before, after in pairwise(slices))


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
    one = derive(parse(data, Path("a.toml")))
    kind = one.types[0]
    first, last = one.sub_imagers[0].window[0], one.sub_imagers[-1].window[0] + ratio * kind.pixels[0]
    assert first >= 0
    assert last <= size
    assert abs((size - last) - first) < 2, "centred to a pixel"
    assert ratio * (kind.pixels[0] + 1) + (count - 1) * step > size, "no larger sub-image would fit"


@pytest.mark.parametrize(
    ("lenses", "words"),
    [
        ((("1/3", [3, 3], [6, 6]),), "at most 5 x 5"),
        ((("1/10", [12, 12], "fit"),), "do not fit"),
    ],
)
def test_what_does_not_fit_is_refused(lenses: tuple[tuple[str, list[int], object], ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        camera((19, 19), lenses)


def test_overlapping_sub_images_are_refused() -> None:
    data = scene((19, 19), THREE).plain()
    data["camera"]["lens_pitch"] = "0.02 mm"
    with pytest.raises(InputError, match=r"lens_pitch.*overlap"):
        derive(parse(data, Path("a.toml")))


def test_gaps_between_windows_are_not_taken_for_seen() -> None:
    data = scene((19, 19), (("1/3", [2, 2], [3, 3]),)).plain()
    data["camera"]["lens"][0]["step"] = 10
    one = derive(parse(data, Path("a.toml")))
    assert one.types_seeing().sum() == (2 * 9) ** 2


def test_too_many_sub_imagers_are_refused_at_once() -> None:
    data = scene((19, 19), (("1/3", [3000, 3000], [1, 1]),)).plain()
    data["camera"]["lens"][0]["step"] = 0
    with pytest.raises(InputError, match="at most 16384"):
        derive(parse(data, Path("a.toml")))
