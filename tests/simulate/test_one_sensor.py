"""Lens types at heights of their own before one sensor, which keeps every magnification."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import light

from ..examples import SLOW_SCALAR, THREE, VARIANTS, needs, with_optics
from .world_files import Z, assert_rendered, glow, rectangle, world

SENSOR = {"common": "sensor"}
NEAR = {"pixel_pitch": "6 um", "distance": "10 mm"}  # images on the sensor at 1/3, 1/5 and 1/4: heights of 1.1 mm


def near(common: str = "sensor", lens: dict[str, Any] | None = None, **tables: Any) -> Setup:
    """A setup with three lens types close to the target, and more keys in every lens type."""
    return Setup(*with_optics(lens or {}, {"common": common}, THREE, target=NEAR, **tables))


def test_the_lenses_of_all_types_stand_before_one_sensor_and_keep_their_magnifications() -> None:
    camera = near().camera
    for lens_type, magnification in zip(camera.types, (1 / 3, 1 / 5, 1 / 4), strict=True):
        distance, depth = camera.distance_of(lens_type), camera.depth(lens_type)
        assert distance + depth == pytest.approx(10 * 4 / 3, rel=1e-14)
        assert depth / distance == pytest.approx(magnification, rel=1e-14)
        assert 1 / camera.focal_length(lens_type) == pytest.approx(1 / depth + 1 / distance, rel=1e-14)
    assert [camera.height(each) for each in camera.types] == pytest.approx([0, 10 / 9, 2 / 3], abs=1e-14)
    alone, _ = camera.restrict(("B",))
    assert alone.height(alone.types[0]) == pytest.approx(10 / 9), "the sensor stays where it is"


def test_ideal_pinholes_see_the_same_wherever_their_plane_is() -> None:
    one, several = near().camera, near("lenses").camera
    assert one.depth(one.types[1]) != several.depth(several.types[1])
    assert (ideal_matrix(one) != ideal_matrix(several)).nnz == 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_pinholes_before_one_sensor_render_their_closed_form(variant: str) -> None:
    needs(variant)
    assert_rendered(near(render={"variant": variant, "samples": 4096}))


@pytest.mark.parametrize("wavelength", ["none", "550 nm"])
def test_lenses_before_one_sensor_render_their_closed_form(wavelength: str) -> None:
    """Out of focus, by rays and by waves; a lens type's focus is the distance from its own lenses."""
    needs("llvm_ad_mono")
    tables: dict[str, Any] = {"render": {"samples": 4096}, "calibration": {"method": "ideal"}}
    setup = near("sensor", {"aperture": "0.4 mm", "focus": "10.6 mm"}, **tables)
    camera = replace(setup.camera, wavelength=None if wavelength == "none" else 550e-6)
    assert_rendered(replace(setup, camera=camera))


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_an_object_beside_the_plane_of_the_target_is_seen_from_the_height_of_each_lens(
    tmp_path: Path, variant: str
) -> None:
    """A square at half the distance is seen where the ray through the lens from its middle meets the target."""
    needs(variant)
    square = rectangle(2, 2, 0, 0, Z / 2, glow(1))
    lenses = (1, [2, 1], [11, 11]), ("1/2", [2, 1], [5, 5])
    pitches = {"lens_pitch": "3 mm", "pixel_pitch": "0.2 mm"}
    described, camera = world(
        tmp_path, square, lenses, variant=variant, camera=pitches | SENSOR, render={"samples": 4096}
    )
    assert camera.height(camera.types[1]) > Z / 12
    rendering = light(Setup(described, camera))
    expected: list[np.ndarray] = []
    for sub in camera.sub_imagers:
        beyond = camera.distance_of(sub.type) / (Z / 2 + camera.height(sub.type))  # over the way from lens to square
        sides: list[np.ndarray] = []
        for axis, offset in enumerate((sub.lens[1], sub.lens[0])):
            middle = 6 + offset * (beyond - 1) / camera.target_pitch
            edges = float(sub.window[axis]) + float(sub.type.ratio) * np.arange(sub.type.pixels[axis] + 1)
            sides.append(np.diff(np.clip(edges, middle - beyond, middle + beyond)) / float(sub.type.ratio))
        expected.append(255 * np.outer(*sides).ravel())
    np.testing.assert_allclose(rendering.mean, np.concatenate(expected), atol=0.01 * 255)


def by_focal_lengths(camera: Camera, common: str) -> Scene:
    """A scene of the same target and lenses, which are described by their focal lengths alone."""
    data = near(common).scene.plain()
    for table, lens_type in zip(data["camera"]["lens"], camera.types, strict=True):
        del table["magnification"]
        table |= {"focal_length": f"{camera.focal_length(lens_type):.12g} mm"}
    return parse(data, Path("test.toml"))


def test_focal_lengths_before_one_sensor_give_the_magnifications() -> None:
    """Each lens is sharp at the distance from the target that it has there, not at that of the foremost one."""
    camera = near().camera
    found = by_focal_lengths(camera, "sensor").camera.lens
    assert [float(lens.magnification) for lens in found] == pytest.approx([1 / 3, 1 / 5, 1 / 4], rel=1e-6)
    other = by_focal_lengths(camera, "lenses").camera.lens[1].magnification
    assert abs(float(other) * 5 - 1) > 0.1, "lenses in one plane are others"


def test_channels_without_walls_need_lenses_in_one_plane() -> None:
    tables: dict[str, Any] = {"target": NEAR, "calibration": {"method": "transport"}}
    with pytest.raises(InputError, match="common"):
        with_optics({"aperture": "0.2 mm"}, {"common": "sensor", "walls": False}, THREE, **tables)
