"""Renderings of worlds, against flat targets and closed forms of perspective and occlusion; light that is none."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.analysis.depth_error import disparity
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.exr import read
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import TRUTH, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.ground_truth import truth
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import cached_stack, light
from ommatid.simulate.renderer.rays import Pixels, Seed
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import activate
from ommatid.simulate.renderer.world import files, has_interreflections, stage
from ommatid.simulate.sampling.passes import Rendering

from ..examples import SLOW_SCALAR, VARIANTS, assert_student, needs
from ..examples import scene as flat_scene
from .world_files import FAST, THIRDS, Z, floored, glow, rectangle, world

CHECKS = (
    '<emitter type="area"><texture type="checkerboard" name="radiance"><float name="color0" value="1.6"/>'
    '<float name="color1" value="0.4"/><transform name="to_uv"><scale x="2" y="2"/></transform></texture></emitter>'
)


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_emissive_checkerboard_equals_the_flat_target_with_that_picture(tmp_path: Path, variant: str) -> None:
    needs(variant)
    board = rectangle(12, 12, 0, 0, Z, CHECKS)
    described, camera = world(tmp_path, board, variant=variant, white=2.0)
    row, column = np.indices((12, 12)) // 3
    picture = np.where((row + column) % 2 == 1, 1.6, 0.4) / 2 * 255  # color0 in the corner where u = v = 0, lower left
    seen = light(Setup(described, camera))
    shown = light(Setup(flat_scene((12, 12), THIRDS, render=described.render.model_dump()), camera, picture))
    assert_student(seen.mean - ideal_matrix(camera) @ picture.ravel(), floored(seen), seen.passes)
    assert_student(seen.mean - shown.mean, floored(seen) + floored(shown), seen.passes)
    exact = truth(Setup(described, camera))
    ray = 1.01 * np.ptp(picture) / exact.samples  # that float32 puts into the square beside it, for 1 seed of 40
    np.testing.assert_allclose(exact.image, picture, rtol=1e-5, atol=ray)
    np.testing.assert_allclose(exact.depth, Z, rtol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_ground_truth_is_the_mean_over_each_pixel(tmp_path: Path, variant: str) -> None:
    """An emissive rectangle whose edges cut pixels at three quarters and at a half gives the covered shares."""
    needs(variant)
    described, camera = world(tmp_path, rectangle(5.5, 7, 0.25, 0, Z, glow(0.5)), variant=variant)
    found = truth(Setup(described, camera))
    across, along = np.zeros(12), np.zeros(12)
    across[3:9] = 1, 1, 1, 1, 1, 0.5  # x from 3 to -2.5 mm, which is to the right
    along[2:10] = 0.5, 1, 1, 1, 1, 1, 1, 0.5
    np.testing.assert_allclose(found.image, 127.5 * np.outer(along, across), rtol=1e-5)
    assert np.isnan(found.depth[0, 0])
    assert np.isfinite(found.depth[5, 5])
    assert found.variance.mean() < 0.01
    assert found.samples == 4 * 256


def test_the_ground_truth_shares_no_ray_with_the_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the seeds of the sampler: with the data's, the estimate would be compared with its own noise."""
    described, camera = world(tmp_path, rectangle(5.5, 7, 0.25, 0, Z, glow(0.5)), variant="scalar_rgb")
    started: list[set[int]] = []
    exposed = Renderer.expose

    def expose(self: Renderer, pixels: Pixels, samples: int, seeds: Sequence[Seed]) -> Any:
        started[-1].update(seed(index) for seed in seeds for index in range(len(camera.sub_imagers)))
        return exposed(self, pixels, samples, seeds)

    monkeypatch.setattr(Renderer, "expose", expose)
    for make in (truth, light):
        started.append(set())
        make(Setup(described, camera))
    assert started[0]
    assert started[1]
    assert not started[0] & started[1]


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_a_ball_occludes_the_background(tmp_path: Path, variant: str) -> None:
    needs(variant)
    x, y, z, radius = 0.7, 0.4, 500.0, 1.2
    ball = f'<shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/>'
    ball += f'<float name="radius" value="{radius}"/>{glow(0.8)}</shape>'
    described, camera = world(tmp_path, rectangle(40, 40, 0, 0, 1500, glow(0.2)) + ball, variant=variant)
    found = truth(Setup(described, camera))
    corners = np.arange(13)
    at_x, at_y = 6.0 - corners[None, :], 6.0 - corners[:, None]
    along = (at_x * x + at_y * y + Z * z) / np.sqrt(at_x**2 + at_y**2 + Z**2)
    hit = along > np.sqrt(x**2 + y**2 + z**2 - radius**2)  # the cone of rays that touch a ball
    quarters = np.stack([hit[:-1, :-1], hit[:-1, 1:], hit[1:, :-1], hit[1:, 1:]])
    inside, outside = quarters.all(axis=0), ~quarters.any(axis=0)
    assert inside.sum() > 5
    assert outside.sum() > 80
    np.testing.assert_allclose(found.image[inside], 0.8 * 255, rtol=1e-4)
    clear = outside & (np.hypot(at_x[:, :-1] - 0.5 - 2 * x, at_y[:-1] - 0.5 - 2 * y) > 2 * radius + 1)
    np.testing.assert_allclose(found.image[clear], 0.2 * 255, rtol=1e-4)
    assert (np.abs(found.depth[inside] - z) <= radius).all()
    np.testing.assert_allclose(found.depth[clear], 1500, rtol=1e-6)


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_a_near_square_moves_by_the_disparity(tmp_path: Path, variant: str) -> None:
    """At half the target's distance, by the lens's own offset from the centre, to the same side."""
    needs(variant)
    square = rectangle(2, 2, 0, 0, Z / 2, glow(1))
    lens_pitch = {"camera": {"lens_pitch": "3 mm"}}
    described, camera = world(tmp_path, square, ((1, [2, 2], [11, 11]),), variant=variant, **lens_pitch)
    rendering = light(Setup(described, camera))
    moved: list[float] = []
    limit = 0.0
    for sub, rows in zip(camera.sub_imagers, camera.slices(), strict=True):
        share, variance = (values[rows].reshape(11, 11) for values in (rendering.mean, floored(rendering)))
        position = np.indices(share.shape) + 0.5
        centroid = (share * position).sum(axis=(1, 2)) / share.sum()
        error = np.sqrt((variance * (position - centroid[:, None, None]) ** 2).sum(axis=(1, 2))) / share.sum()
        limit = max(limit, 5 * float(error.max()))
        expected = [6 - offset * (1 - Z / (Z / 2)) / camera.target_pitch for offset in (sub.lens[1], sub.lens[0])]
        centre = centroid + [float(start) for start in sub.window[:2]]
        assert centre == pytest.approx(np.array(expected), abs=limit), "within five standard errors"
        moved.append(float(((centre - 6) ** 2).sum()))
    assert np.mean(moved) ** 0.5 == pytest.approx(float(disparity(camera, Z / 2)["A"]), abs=limit)


def test_the_target_is_part_of_its_world(tmp_path: Path) -> None:
    """The flat target keeps its own values for any radiance of white; objects in front of it occlude it."""
    needs(FAST)
    content = '<emitter type="constant"/>' + rectangle(2, 2, 0, 0, Z / 2, glow(3))
    picture = {"image": "photo:camera", "origin": [96, 224]}
    described, camera = world(tmp_path, content, target=picture, white=3.0)
    image = load(described)
    found = truth(Setup(described, camera, image))
    hidden = np.zeros((12, 12), dtype=bool)
    hidden[4:8, 4:8] = True
    np.testing.assert_allclose(found.image[~hidden], image[~hidden], rtol=1e-5)
    np.testing.assert_allclose(found.image[hidden], 255, rtol=1e-4)
    np.testing.assert_allclose(found.depth, np.where(hidden, Z / 2, Z), rtol=1e-6)


def test_every_lens_reads_the_value_of_a_uniform_world(tmp_path: Path) -> None:
    needs(FAST)
    described, _ = world(tmp_path, '<emitter type="constant"><float name="radiance" value="0.4"/></emitter>')
    data = described.plain()
    data["camera"]["lens"][1] |= {"aperture": "0.1 mm", "focus": "700 mm"}
    blurred = parse(data, Path("test.toml"))
    camera = derive(blurred)
    np.testing.assert_allclose(light(Setup(blurred, camera)).mean, 0.4 * 255, rtol=2e-6)
    assert np.isnan(truth(Setup(blurred, camera)).depth).all()


def test_an_aperture_blurs_objects_out_of_focus(tmp_path: Path) -> None:
    """At half the focused distance by a disk as wide as the aperture, less bright towards its rim.

    Variances along an axis add: of a square of 2 pixels, 2^2/12, of a pixel, 1/12, and of the disk: with u the squared
    tangent of a ray's angle at the sensor and cos^4 = 1/(1 + u)^2, half the mean of u depth^2 so weighted.
    """
    needs(FAST)
    square = rectangle(1, 1, 0, 0, Z / 2, glow(1))
    described, camera = world(tmp_path, square, ((1, [1, 1], [12, 12]),), render={"samples": 16384})
    data = described.plain()
    data["camera"]["lens"][0]["aperture"] = "4 mm"
    data["camera"]["wavelength"] = "none"
    blurred = parse(data, Path("test.toml"))
    seen = light(Setup.from_scene(blurred)).mean.reshape(12, 12)
    away = (np.arange(12) - 5.5) ** 2
    spread = [float((seen.sum(axis=axis) * away).sum() / seen.sum()) for axis in (0, 1)]
    steepest = (2.0 / camera.depth(camera.types[0])) ** 2
    share = steepest / (1 + steepest)
    disk = camera.depth(camera.types[0]) ** 2 / 2 * (np.log1p(steepest) / share - 1)
    assert spread == pytest.approx([4 / 12 + disk + 1 / 12] * 2, rel=0.01)


LIT = (
    rectangle(40, 40, 0, 0, 1200, '<bsdf type="diffuse"/>')
    + '<shape type="sphere"><point name="center" x="0" y="0" z="900"/><float name="radius" value="3"/></shape>'
    + '<shape type="rectangle"><transform name="to_world"><scale value="20"/>'
    + f'<lookat origin="60, 50, 850" target="0, 0, 1000" up="0, 1, 0"/></transform>{glow(9)}</shape>'
)


def test_interreflections_are_the_same_on_both_backends(tmp_path: Path) -> None:
    """Shadows and interreflections between wall and ball; different seeds, so independent noise."""
    needs(FAST)
    found: list[Rendering] = []
    for variant in VARIANTS:
        described, camera = world(tmp_path, LIT, variant=variant)
        found.append(light(Setup(described, camera)))
    assert found[0].mean.std() > 5 < found[0].mean.mean()
    assert_student(found[0].mean - found[1].mean, floored(found[0]) + floored(found[1]), found[0].passes)


BLACK = '<shape type="sphere"><bsdf type="diffuse"><float name="reflectance" value="0"/></bsdf></shape>'


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (rectangle(1, 1, 0, 0, Z, glow(1)) + BLACK, False),
        (LIT, True),
        (rectangle(1, 1, 0, 0, Z, glow(1) + '<bsdf type="null"/>'), True),  # what is behind shines through
        (rectangle(1, 1, 0, 0, Z, glow(1) + '<bsdf type="dielectric"/>'), True),
    ],
)
def test_interreflections_exist_unless_all_is_black(tmp_path: Path, content: str, expected: bool) -> None:
    described, _ = world(tmp_path, content)
    assert has_interreflections(stage(described, "scalar_rgb", None).scene) is expected


def test_omitting_absent_interreflections_changes_no_digit(tmp_path: Path) -> None:
    """With and without them every pixel is the same, and the record says that they were left out."""
    needs(FAST)
    content = rectangle(6, 6, 1, 2, Z, CHECKS + '<bsdf type="diffuse"><float name="reflectance" value="0"/></bsdf>')
    found: list[Rendering] = []
    for inside, render in ((content, {}), (content, {"complete": True}), (LIT, {})):
        described, camera = world(tmp_path, inside, render=render)
        found.append(light(Setup(described, camera)))
    assert [rendering.direct_only for rendering in found] == [True, False, False]
    np.testing.assert_allclose(found[0].mean, found[1].mean, rtol=1e-6)


def test_a_changed_world_or_file_of_it_is_rendered_again(tmp_path: Path) -> None:
    needs(FAST)
    part = tmp_path / "part.xml"

    def shining(radiance: float) -> None:
        lamp = f'<emitter type="constant"><float name="radiance" value="{radiance}"/></emitter>'
        part.write_text(f'<scene version="3.0.0">{lamp}</scene>', encoding="utf-8")

    shining(0.25)
    described, camera = world(tmp_path, '<include filename="part.xml"/>')
    assert files(described) == [tmp_path / "world.xml", part]
    image, path = load(described), tmp_path / "stack.exr"

    def keep() -> tuple[float, bool]:
        stack, made = cached_stack(path, Setup(described, camera, image), lambda _: None)
        known = read(tmp_path / TRUTH)[0].channels
        assert stack.record["truth"] == digest(known["Y"])
        assert known["Y"].mean() == pytest.approx(float(stack.values.mean()), rel=1e-5)
        assert np.isnan(known["depth"]).all()
        return float(stack.values.mean()), made

    assert keep() == (pytest.approx(255 / 4), True)
    before = (tmp_path / TRUTH).stat().st_mtime_ns
    assert keep() == (pytest.approx(255 / 4), False)
    assert (tmp_path / TRUTH).stat().st_mtime_ns == before
    shining(0.5)
    assert keep() == (pytest.approx(255 / 2), True)


LIGHT = r"expected readings of 0 to 1e\+15, .*, got"


def shape_at(change: str, value: str) -> str:
    where = f'<transform name="to_world"><{change} z="{value}"/></transform>'
    return f'<emitter type="constant"/><shape type="cube" id="far">{where}</shape>'


SKY, FROM_FILE = '<emitter type="constant"/>', {"camera": "from file"}
SENSOR = '<sensor type="perspective"><transform name="to_world"><scale x="SCALE"/></transform></sensor>'
CHANNELS = SKY + '<integrator type="INTEGRATOR<integrator type="path"/></integrator>'


@pytest.mark.parametrize(
    ("content", "table", "complaint"),
    [
        ('<shape type="sphere"><float name="weight" value="1"/></shape>', {}, "unreferenced property"),
        ('<shape type="sphere"/>', {}, "has no emitter"),
        (shape_at("translate", "1e400"), {}, "finite positions, got shape 'far' from -1, -1, inf to"),
        (shape_at("scale", "nan"), {}, "finite positions, got shape 'far' from -1, -1, nan to"),
        (SKY + '<integrator type="ptracer"/>', {}, "does not follow rays from a camera"),
        *(
            (CHANNELS.replace("INTEGRATOR", kind), {}, r"returns \d+ more channels \(.*\); expected the radiance alone")
            for kind in ('aov"><string name="aovs" value="a:depth"/>', 'moment">')
        ),
        (SKY, FROM_FILE, "expected one sensor, got 0; add one"),
        (SKY + 2 * SENSOR.replace("SCALE", "1"), FROM_FILE, "expected one sensor, got 2; leave one"),
        (
            SKY + '<sensor type="radiancemeter"/>',
            FROM_FILE,
            "expected one with a to_world, got a 'radiancemeter' without",
        ),
        (SKY + SENSOR.replace("SCALE", "2"), FROM_FILE, "got one that shears or stretches"),
        *(
            (rectangle(4, 4, 0, 0, Z, glow(radiance)) + rectangle(40, 40, 0, 0, 2 * Z, glow(1)), {}, LIGHT)
            for radiance in ("nan", "inf", "-1", "1e30")
        ),
    ],
)
def test_a_world_that_cannot_be_rendered_is_refused(
    tmp_path: Path, content: str, table: dict[str, str], complaint: str
) -> None:
    """In one sentence, by both backends where light is none."""
    for variant in VARIANTS if complaint == LIGHT else VARIANTS[:1]:
        needs(variant)
        described, camera = world(tmp_path, content, variant=variant, world=table)
        for make in (truth, light) if complaint == LIGHT else (truth,):
            with pytest.raises(InputError, match=complaint) as told:
                make(Setup(described, camera))
            text = str(told.value)
            assert text.startswith("test.toml: world.file: ")
            assert "\n" not in text
            assert ".cpp" not in text


@pytest.mark.parametrize("variant", VARIANTS)
def test_bright_worlds_and_signed_pictures_are_rendered(tmp_path: Path, variant: str) -> None:
    needs(variant)
    described, camera = world(tmp_path, rectangle(40, 40, 0, 0, Z, glow(1e12)), variant=variant)
    assert light(Setup(described, camera)).mean == pytest.approx(255e12, rel=1e-5)
    if variant.startswith("scalar"):
        return  # where Mitsuba's films take no negative light
    picture = {"image": "photo:camera", "origin": [96, 224]}
    described, camera = world(tmp_path, SKY, target=picture, variant=variant)
    image = np.random.default_rng(1).normal(size=camera.shape)
    assert light(Setup(described, camera, image)).mean.min() < 0


def test_every_kind_of_message_appears_once(caplog: pytest.LogCaptureFixture) -> None:
    activate("scalar_rgb")
    import mitsuba as mi

    log: Any = mi.Log
    with caplog.at_level(logging.WARNING, "mitsuba"):
        for number in range(3):
            log(mi.LogLevel.Warn, f'"mesh{number}.ply": {number} vertices of this test are odd')
    assert len(caplog.records) == 1
    assert caplog.records[0].getMessage().endswith('"mesh0.ply": 0 vertices of this test are odd')
