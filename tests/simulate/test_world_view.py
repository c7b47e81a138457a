"""What a camera sees of a world: surfaces, their distances, the radiance of white, and cameras that see nothing."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import parse, write
from ommatid.scenes.setup import Setup
from ommatid.simulate import world_view as module
from ommatid.simulate.ground_truth import truth
from ommatid.simulate.render import render
from ommatid.simulate.world_view import WorldView, check_world, views, world_view

from ..conftest import Command
from ..examples import VARIANTS, needs
from ..examples import camera as three_types
from .world_files import FAST, Z, glow, rectangle, world

SKY = '<emitter type="constant"><float name="radiance" value="0.5"/></emitter>'
ONE = ((1, [1, 1], [12, 12]),)


def view_of(folder: Path, content: str, **more: Any) -> WorldView:
    described, camera = world(
        folder, content, more.pop("lenses", ONE), variant=more.pop("variant", "scalar_rgb"), **more
    )
    return check_world(Setup(described, camera))


def test_views_are_spread_evenly_over_the_pixels_of_every_sub_imager() -> None:
    """Of each, 16 views through the middle of its lens, whose mean is the middle of its window."""
    camera = three_types()
    origins, directions = views(camera)
    points = (origins + directions).reshape(-1, 16, 3)
    assert len(points) == len(camera.sub_imagers)
    for sub, start, seen in zip(camera.sub_imagers, origins.reshape(-1, 16, 3), points, strict=True):
        middle = camera.position(*sub.type.middle(sub.window))
        np.testing.assert_allclose(seen.mean(axis=0), [*middle, camera.distance])
        np.testing.assert_allclose(start, np.tile([*sub.lens, 0], (16, 1)))
        height, width = (float(sub.type.ratio) * count * camera.target_pitch for count in sub.type.pixels)
        np.testing.assert_allclose(np.ptp(seen, axis=0), [0.75 * width, 0.75 * height, 0])


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_view_tells_share_distances_and_box(tmp_path: Path, variant: str) -> None:
    """Three quarters of a pinhole's 16 views meet a wall that covers three quarters of the target, twice as near."""
    needs(variant)
    wall = rectangle(4.5, 6, 0.75, 0, Z / 2, glow(0.5)) + rectangle(1, 1, 700, -300, 2000, glow(0.5))
    for unit, factor in (("mm", 1.0), ("cm", 10.0)):
        view = view_of(tmp_path, wall, variant=variant, world={"unit": unit})
        assert (view.met, view.views, view.sky, view.white) == (12, 16, False, 1.0)
        assert view.depths == pytest.approx([factor * Z / 2] * 3, rel=1e-6)
        least, most = np.array(view.box) / factor
        assert least == pytest.approx([-1.5, -300.5, Z / 2], abs=1e-3)
        assert most == pytest.approx([700.5, 3, 2000], abs=1e-3)


def hiding(height: float) -> str:
    """Of rows of views at 1.5, 4.5, 7.5 and 10.5 mm from the top, a wall of 4.4 mm there hides one, of 4.6 two."""
    return rectangle(20, height, 0, 6 - height / 2, Z, glow(1))


# As wide as the lens array, so that it fills every view; lenses 0.5 mm apart see parts of it with nothing in common:
# 500 mm apart on the target, which has 12 mm.
METRES, ARRAY = rectangle(3, 3, 0, 0, 1, glow(1)), ((1, [2, 2], [11, 11]),)
BESIDE = rectangle(20, 20, 300, 0, Z, glow(1))
REFUSED: list[tuple[str, Any, tuple[str, ...], str]] = [
    (
        BESIDE,
        ONE,
        (
            "0 of 16 views of sensor pixels meet a surface, expected half or more",
            "looks along +z and sees x -6 to 6, y -6 to 6 mm at 1000 mm",
            "the world's bounding box is x 290 to 310, y -10 to 10, z 1000 to 1000 mm",
        ),
        "",
    ),
    (hiding(4.4), ONE, ("4 of 16 views",), ""),
    (SKY + BESIDE, ONE, ("0 of 16 views",), ""),
    (f'<sensor type="perspective"/>{BESIDE}', ONE, (), "or take world.camera = 'from file'"),
    (
        METRES,
        ARRAY,
        (
            "half of the surfaces that the camera sees are nearer than 1 mm, and the target's plane is at 1000 mm",
            "pixels of f, more than the whole",
        ),
        "set world.unit = 'm' if the file is in m, or move the world with world.to_world",
    ),
]


@pytest.mark.parametrize(("content", "lenses", "words", "end"), REFUSED)
def test_a_camera_that_sees_next_to_nothing_is_refused(
    content: str, lenses: Any, words: tuple[str, ...], end: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as told:
        view_of(tmp_path, content, lenses=lenses)
    text = str(told.value)
    assert text.startswith("test.toml: world.file: ")
    assert all(each in text for each in words), text
    assert "\n" not in text
    assert text.endswith(end)
    assert lenses == ONE or re.search("displaced by (499|500) pixels", text)


def test_a_camera_that_sees_enough_is_not(tmp_path: Path) -> None:
    """Half of the views; or under a sky, one surface or none; or a world in metres that is said to be so."""
    assert view_of(tmp_path, hiding(4.6)).met == 8
    assert view_of(tmp_path, SKY).box is None
    assert view_of(tmp_path, SKY + rectangle(3, 3, 1.5, 1.5, Z, glow(1))).met == 1
    assert view_of(tmp_path, METRES, lenses=ARRAY, world={"unit": "m"}).depths == pytest.approx([Z] * 3)


def test_a_picture_is_seen_wherever_the_world_is(tmp_path: Path) -> None:
    picture = {"image": "photo:camera", "origin": [96, 224]}
    view = view_of(tmp_path, BESIDE, target=picture)
    assert view.met == 0
    first, *_ = module.rows(view.describe())
    assert first == ("what the camera sees without the picture", "a surface in 0 of 16 views of sensor pixels")


def spot(pixels: int, white: float = 8.0) -> str:
    """Return a wall of radiance 0.25 with a luminous square of so many of 48 x 48 pixels along its side."""
    side = pixels * 0.25
    return rectangle(30, 30, 0, 0, Z + 1, glow(0.25)) + rectangle(side, side, 0, 0, Z, glow(white))


def fine(folder: Path, content: str, variant: str, **keys: Any) -> Setup:
    """Return a pinhole of 48 x 48 pixels of f that finds white in front of a world of this content."""
    described, _ = world(folder, content, ONE, variant=variant, white="auto")
    data = described.plain()
    data["target"] |= {"shape": [48, 48], "pixel_pitch": "0.25 mm"}
    data["camera"]["lens"][0] |= {"magnification": "1/4", "pixels": "fit"}
    data["render"]["samples"] = 16
    return Setup.from_scene(parse(data | keys, Path("test.toml")))


@pytest.mark.parametrize("variant", VARIANTS)
def test_white_is_brighter_than_all_but_half_a_percent(tmp_path: Path, variant: str) -> None:
    """Half a percent of 48 x 48 pixels are 11.5: a square of 2 x 2 of them is left out, one of 4 x 4 is white."""
    needs(variant)
    for pixels, expected in ((2, 0.25), (4, 8.0)):
        setup = fine(tmp_path, spot(pixels), variant)
        assert world_view(setup).white == pytest.approx(expected, rel=1e-5)
        if variant == FAST:
            continue
        stack = render(setup)
        assert stack.record["white"] == world_view(setup).white
        assert float(np.median(stack.values)) == pytest.approx(255 * 0.25 / expected, rel=1e-5)
        assert truth(setup).image.max() == pytest.approx(255 * 8.0 / expected, rel=1e-4)


DIFFUSE = rectangle(30, 30, 0, 0, Z, '<bsdf type="diffuse"/>')


def lit(radiance: float) -> str:
    """Return a diffuse wall, lit from the side by a luminous rectangle."""
    place = '<scale value="300"/><lookat origin="500, 400, 600" target="0, 0, 1000" up="0, 1, 0"/>'
    return f'{DIFFUSE}<shape type="rectangle"><transform name="to_world">{place}</transform>{glow(radiance)}</shape>'


def test_white_does_not_depend_on_threads_but_on_the_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: Callable[[int], None]
) -> None:
    needs(FAST)
    whites: list[float] = []
    for count, seed in ((1, 0), (2, 0), (2, 1)):
        threads(count)
        monkeypatch.setattr(module, "_known", {})
        setup = fine(tmp_path, lit(3), FAST, render={"variant": FAST, "samples": 16, "seed": seed})
        whites.append(world_view(setup).white)
    assert whites[0] == whites[1] != whites[2] == pytest.approx(whites[1], rel=0.05)


def test_white_of_a_dark_world_is_refused(tmp_path: Path) -> None:
    behind = '<emitter type="spot"><transform name="to_world"><lookat origin="0,0,-5" target="0,0,-9" up="0,1,0"/>'
    setup = fine(tmp_path, f"{DIFFUSE}{behind}</transform></emitter>", "scalar_rgb")
    with pytest.raises(InputError, match=r"world\.white 'auto' needs light that the camera sees, got a black view"):
        check_world(setup)


def test_the_picture_before_a_world_has_no_part_in_white(tmp_path: Path) -> None:
    picture = {"image": "photo:camera", "origin": [96, 224]}
    described, camera = world(
        tmp_path, rectangle(30, 30, 0, 0, 1500, glow(0.5)), ONE, target=picture, white="auto", variant="scalar_rgb"
    )
    setup = Setup(described, camera)
    assert world_view(setup).white == pytest.approx(0.5, rel=1e-5)
    np.testing.assert_allclose(truth(setup).image, setup.image, rtol=1e-4, atol=0.01)


def test_show_prints_what_the_camera_sees(here: Path, ommatid: Command) -> None:
    described, _ = world(here, rectangle(0.02, 0.02, 0, 0, 1, glow(2)), variant="scalar_rgb", white="auto")
    write(here / "metres.toml", described)
    ended = ommatid("show", "metres.toml", "--set", "world.unit=m", "--json")
    assert ended.code == 0
    seen = json.loads(ended.out)["world"]
    assert (seen["views_that_meet_a_surface"], seen["views"]) == (208, 208)
    assert [seen["nearest"], seen["farthest"], seen["white"]] == pytest.approx([1000, 1000, 2.0], rel=1e-5)
    table = dict(module.rows(seen))
    assert table["what the camera sees"] == "a surface in 208 of 208 views of sensor pixels"
    assert table["surfaces in view"] == "1000 to 1000 mm away, half of them nearer than 1000 mm"
