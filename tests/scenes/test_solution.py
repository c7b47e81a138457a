"""The geometry of a camera from any sufficient set of keys, and the sets that contradict themselves."""

from __future__ import annotations

from fractions import Fraction
from math import atan, radians, tan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import Scene, parse

from ..examples import not_none

LENS = {"name": "I", "magnification": "1/3", "array": [1, 1], "pixels": [5, 5]}


def described(target: dict[str, Any], camera: dict[str, Any], **lens: Any) -> Scene:
    """A scene of one lens, without a picture; a key that is None is absent."""
    tables = {"shape": [200, 200], "pixel_pitch": "1 mm", "distance": "1 m"} | target
    camera = {"pixel_pitch": "6 um", "lens_pitch": "50 mm"} | camera
    data = {"target": present(tables), "camera": {**present(camera), "lens": [present(LENS | lens)]}}
    return parse(data, Path("a.toml"))


def present(table: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if value is not None}


def refusal(target: dict[str, Any], camera: dict[str, Any], **lens: Any) -> str:
    with pytest.raises(InputError) as caught:
        described(target, camera, **lens)
    return str(caught.value)


def test_a_focal_length_gives_the_pitch_of_the_target() -> None:
    """2 mm at 0.5 m images at 2/498 = 1/249: a pixel of 1.55 um spans 385.95 um, and 1/3 makes that 3 x 128.65 um."""
    scene = described({"pixel_pitch": None, "distance": "0.5 m"}, {"pixel_pitch": "1.55 um"}, focal_length="2 mm")
    assert scene.target.pixel_pitch == pytest.approx(0.12865, rel=1e-14)
    camera = derive(scene)
    assert camera.focal_length(camera.types[0]) == pytest.approx(2, rel=1e-14)
    assert camera.depth(camera.types[0]) == pytest.approx(500 / 249, rel=1e-14)


def test_a_magnification_of_large_numbers_becomes_the_simplest_within_a_millionth() -> None:
    """2 mm at 0.5 m and 0.13 mm: 0.13 / (249 * 0.00155) = 2600/7719."""
    table = {"distance": "0.5 m", "pixel_pitch": "0.13 mm"}
    scene = described(table, {"pixel_pitch": "1.55 um"}, focal_length="2 mm", magnification=None)
    found, exact = scene.camera.lens[0].magnification, Fraction(2600, 7719)
    assert abs(found / exact - 1) <= Fraction(1, 2 * 10**6)
    simpler = (Fraction(round(exact * size), size) for size in range(1, found.denominator))
    assert all(abs(ratio / exact - 1) > Fraction(1, 2 * 10**6) for ratio in simpler)


def test_a_focus_of_its_own_counts() -> None:
    """2 mm in focus at 0.4 m stands 800/398 mm before the sensor, and images a target at 0.5 m at 1.6/398."""
    optics = {"focal_length": "2 mm", "focus": "0.4 m", "aperture": "0.1 mm"}
    scene = described({"pixel_pitch": None, "distance": "0.5 m"}, {}, **optics)
    assert scene.target.pixel_pitch == pytest.approx(0.006 * 398 / 1.6 / 3, rel=1e-12)


def test_a_field_of_view_gives_the_pixels() -> None:
    """Behind 2 mm, 30 degrees span 4 tan(15 deg) = 1.072 mm: 178.6 pixels of 6 um; 10 degrees: 58.3."""
    lens = described({"pixel_pitch": "4 mm", "shape": [999, 999]}, {}, pixels=None, field_of_view=["2 deg", "6 deg"])
    depth = 1000 * 0.006 / 3 / 4
    expected = [round(2 * depth * tan(radians(angle) / 2) / 0.006) for angle in (2, 6)]
    assert list(lens.camera.lens[0].pixels) == expected
    square = described({"pixel_pitch": "4 mm", "shape": [999, 999]}, {}, pixels=None, field_of_view="6 deg")
    assert square.camera.lens[0].pixels == (expected[1], expected[1])


def test_what_follows_is_written_and_what_it_came_from_is_not() -> None:
    scene = described({"pixel_pitch": None}, {}, focal_length="2 mm", f_number=8)
    plain = scene.plain()
    assert {"focal_length", "f_number", "field_of_view"} & plain["camera"]["lens"][0].keys() == set()
    assert parse(plain, Path("a.toml")).plain() == plain


@pytest.mark.parametrize("focal_length", ["2 mm", "1.996 mm", "2.00 mm", "1.996008 mm", "0.001996 m"])
def test_a_redundant_length_agrees_to_its_digits(focal_length: str) -> None:
    """1/3 of 1 mm at 1 m with 6 um is 2000/1002 = 1.9960080 mm; 2 mm counts as 1.995 to 2.005 mm."""
    assert described({}, {}, focal_length=focal_length).camera.lens[0].magnification == Fraction(1, 3)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"focal_length": "1.99 mm"}, ("lens.I.focal_length: got 1.99 mm", "magnification 1/3", "make it 1.996 mm")),
        ({"focal_length": "2.000 mm"}, ("got 2.000 mm", "1000 mm", "0.006 mm", "remove or correct one")),
        ({"focal_length": "1 m"}, ("focal_length 1000 mm", "less than", "1000 mm")),
        ({"f_number": 4.0, "aperture": "0.2 mm"}, ("f_number: got 4.0", "aperture of 0.2 mm", "make it 9.98")),
        ({"field_of_view": "2 deg"}, ("field_of_view: got 2 deg", "11.64 pixels", "5 columns", "0.8594 deg")),
        ({"focal_length": "9 mm", "magnification": None}, ("spans 0.6607 pixels", "0.66067 mm or less")),
        ({"magnification": None}, ("magnification' is missing", "focal_length with target.distance")),
        ({"f_number": 4, "surfaces": [{"semi_diameter": "1 mm"}]}, ("f_number belongs to a thin lens",)),
    ],
)
def test_wrong_geometries_are_refused_with_the_numbers(keys: dict[str, Any], words: tuple[str, ...]) -> None:
    message = refusal({}, {}, **keys)
    assert all(word in message for word in words), message
    assert "more to correct" not in message


def test_a_geometry_that_does_not_suffice_names_what_is_missing() -> None:
    assert "key 'target.distance' is missing" in refusal({"distance": None}, {})
    both = refusal({"distance": None, "pixel_pitch": None}, {}, focal_length="2 mm")
    assert "key 'target.pixel_pitch' is missing and has no default; add it, or magnification and focal_length" in both


# Of the keys magnification, focal length, distance, both pitches, field of view, pixels, f-number and aperture, those
# that may be absent together: one of the first five, and of the others, as long as two of them give the focal length.
ABSENT = [
    *([], ["magnification"], ["focal_length"], ["distance"], ["pitch"], ["sensor"], ["field_of_view"], ["pixels"]),
    *(["f_number"], ["aperture"], ["magnification", "pixels"], ["magnification", "aperture"], ["distance", "f_number"]),
    *(["pitch", "pixels", "aperture"], ["sensor", "pixels"], ["focal_length", "f_number"], ["focal_length", "pixels"]),
    *(["focal_length", "pitch"], ["focal_length", "magnification"], ["focal_length", "distance", "field_of_view"]),
    *(["focal_length", "sensor"], ["focal_length", "pitch", "f_number"]),
]


@settings(deadline=None, max_examples=80)
@given(
    st.fractions(1, 9, max_denominator=7),
    st.integers(1, 40).map(lambda n: n / 4),  # focal length
    st.integers(50, 3000),  # distance
    st.integers(4, 40).map(lambda n: n / 4e3),  # pixel pitch
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    st.integers(5, 160).map(lambda n: n / 10),  # f-number
    st.sampled_from(ABSENT),
)
def test_any_sufficient_set_describes_the_same_camera(
    ratio: Fraction,
    focal_length: float,
    distance: int,
    sensor: float,
    pixels: tuple[int, int],
    number: float,
    absent: list[str],
) -> None:
    depth = focal_length * distance / (distance - focal_length)
    views = [f"{2 * atan(count * sensor / depth / 2)!r} rad" for count in pixels]
    pitch = sensor * distance / depth / float(ratio)
    keys: dict[str, Any] = {
        "magnification": str(1 / ratio),
        "focal_length": f"{focal_length!r} mm",
        "distance": f"{distance} mm",
        "pitch": f"{pitch!r} mm",
        "sensor": f"{sensor!r} mm",
        "field_of_view": views,
        "pixels": list(pixels),
        "f_number": number,
        "aperture": f"{focal_length / number!r} mm",
    }
    keys |= dict.fromkeys(absent)
    target = {"distance": keys.pop("distance"), "pixel_pitch": keys.pop("pitch")}
    camera = derive(described(target, {"pixel_pitch": keys.pop("sensor")}, **keys))
    lens = camera.types[0]
    assert (lens.ratio, lens.pixels) == (ratio, pixels)
    found = camera.target_pitch, camera.distance, camera.pixel_pitch, *optics_of(camera)
    assert found == pytest.approx((pitch, distance, sensor, depth, focal_length, focal_length / number), rel=1e-9)


def optics_of(camera: Camera) -> tuple[float, float, float]:
    lens = camera.types[0]
    return camera.depth(lens), camera.focal_length(lens), not_none(lens.optics.aperture)


def test_the_schema_allows_every_key_that_may_follow_from_others_to_be_absent() -> None:
    tables = Scene.model_json_schema()["$defs"]
    required = {name: set(tables[name]["required"]) for name in ("TargetTable", "CameraTable", "LensTable")}
    assert required == {"TargetTable": set(), "CameraTable": {"lens_pitch", "lens"}, "LensTable": {"name", "array"}}
