"""Worlds in other units and poses, against the same worlds in millimetres and Mitsuba's own sensor."""

from __future__ import annotations

from contextlib import nullcontext
from math import atan, degrees
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.world import MILLIMETRES, WorldTable
from ommatid.simulate.ground_truth import Truth, truth
from ommatid.simulate.render import light
from ommatid.simulate.renderer.variant import activate
from ommatid.simulate.renderer.worlds.placement import Placement
from ommatid.simulate.sampling.passes import Rendering

from ..examples import needs
from .world_files import FAST, LETTER, Z, glow, rectangle, world

ANGLE, SHIFT, FACTOR = 40.0, (30.0, -20.0, 50.0), 2.0
AXIS = (2 / 3, -1 / 3, 2 / 3)  # of length 1, which Mitsuba takes for granted
PINHOLES = (("1/3", [2, 2], [3, 3]),)
PINHOLE = ((1, [1, 1], [12, 12]),)
PATHS = '<integrator type="path"><integer name="max_depth" value="2"/></integrator>'


def lamp(x: float, y: float, z: float, intensity: float) -> str:
    place = f'<point name="position" x="{x}" y="{y}" z="{z}"/>'
    return f'<emitter type="point">{place}<float name="intensity" value="{intensity}"/></emitter>'


def lit_room(millimetres: float) -> str:
    """Return a lamp, a diffuse wall and a luminous ball before it, in a unit of so many millimetres."""
    ball = f'<point name="center" x="{0.7 / millimetres}" y="{0.4 / millimetres}" z="{500 / millimetres}"/>'
    ball += f'<float name="radius" value="{1.2 / millimetres}"/>{glow(0.8)}'
    wall = rectangle(*(value / millimetres for value in (60, 60, 0, 0, 1100)), rest='<bsdf type="diffuse"/>')
    # A lamp of intensity I at a distance r gives the irradiance I / r^2, so that I counts squares of the unit.
    bulb = lamp(*(value / millimetres for value in (5, 9, 700)), intensity=5e5 / millimetres**2)
    return f'{wall}<shape type="sphere">{ball}</shape>{bulb}{PATHS}'


def assert_same(one: FloatArray, other: FloatArray, rays: int) -> None:
    """Assert that readings of 0 to 255 are those of the same rays, of which rounding may put two across an edge."""
    assert np.abs(one - other).max() <= 2 * 255 / rays
    assert np.abs(one - other).mean() <= 255 / rays / 10


def both(described: Scene) -> tuple[Rendering, Truth]:
    setup = Setup.from_scene(described)
    return light(setup), truth(setup)


def in_unit(folder: Path, unit: str, variant: str) -> Scene:
    return world(folder, lit_room(MILLIMETRES[unit]), PINHOLES, variant=variant, world={"unit": unit})[0]


def test_a_world_reads_the_same_in_millimetres_and_inches(tmp_path: Path) -> None:
    """Its lamp too, whose watts are those of the file's unit."""
    (rendering, exact), (other, known) = (both(in_unit(tmp_path, unit, "scalar_rgb")) for unit in ("mm", "in"))
    assert 20 < rendering.mean.min() < 0.8 * rendering.mean.max() < 255
    assert_same(other.mean, rendering.mean, 256)
    assert_same(known.image, exact.image, exact.samples)
    np.testing.assert_allclose(known.depth, exact.depth, rtol=1e-4)


def moved(shape: str, mirrored: bool) -> str:
    """Return a shape that is enlarged, mirrored, turned and moved within its file."""
    turn = "".join(f' {name}="{value}"' for name, value in zip("xyz", AXIS, strict=True))
    by = "".join(f' {name}="{value}"' for name, value in zip("xyz", SHIFT, strict=True))
    size = f'<scale x="{-FACTOR if mirrored else FACTOR}" y="{FACTOR}" z="{FACTOR}"/>'
    steps = f'{size}<rotate{turn} angle="{ANGLE}"/><translate{by}/>'
    return shape.replace("</transform>", f"{steps}</transform>")


def back(mirrored: bool) -> list[list[float]]:
    """Return the inverse of that motion."""
    there = np.eye(4)
    size = np.diag([-FACTOR if mirrored else FACTOR, FACTOR, FACTOR])
    there[:3, :3] = Rotation.from_rotvec(np.radians(ANGLE) * np.array(AXIS)).as_matrix() @ size
    there[:3, 3] = SHIFT
    return np.linalg.inv(there).tolist()


@pytest.mark.parametrize(("variant", "mirrored"), [("scalar_rgb", False), (FAST, True)])
def test_to_world_undoes_a_motion_of_the_file(tmp_path: Path, variant: str, mirrored: bool) -> None:
    needs(variant)
    shapes = [rectangle(7, 5.5, 0.25, 1, Z, glow(0.5)), rectangle(1, 2, -1, 0, Z / 2, glow(0.9))]
    shapes += [rectangle(60, 60, 0, 0, 1200, glow(0.1))]
    described, _ = world(tmp_path, "".join(shapes), PINHOLES, variant=variant)
    rendering, exact = both(described)
    content = "".join(moved(shape, mirrored) for shape in shapes)
    described, _ = world(tmp_path, content, PINHOLES, variant=variant, world={"to_world": back(mirrored)})
    other, known = both(described)
    assert rendering.mean.std() > 20
    assert_same(other.mean, rendering.mean, 256)
    assert_same(known.image, exact.image, exact.samples)
    np.testing.assert_allclose(known.depth, exact.depth, rtol=1e-4)


def test_the_picture_stands_before_the_camera_in_a_world_that_is_moved(tmp_path: Path) -> None:
    needs(FAST)
    picture = {"image": "photo:camera", "origin": [96, 224]}
    found: list[Truth] = []
    for place in ({}, {"to_world": [{"rotate": [0, 1, 0], "angle": "90 deg"}, {"translate": [3, 0, 0]}], "unit": "m"}):
        described, _ = world(tmp_path, '<emitter type="constant"/>', PINHOLES, target=picture, world=place)
        found.append(truth(Setup.from_scene(described)))
    assert_same(found[1].image, found[0].image, found[0].samples)
    np.testing.assert_allclose(found[1].depth, Z, rtol=1e-5)


SENSOR = f"""<sensor type="perspective"><float name="fov" value="{2 * degrees(atan(6 / Z))}"/>
    <float name="near_clip" value="0.001"/><transform name="to_world">POSE</transform><film type="hdrfilm">
    <integer name="width" value="12"/><integer name="height" value="12"/><rfilter type="box"/></film></sensor>"""
LOOK = '<lookat origin="0.3, -0.2, 0.4" target="1.1, 0.6, 0.1" up="0.2, 1, 0.1"/>'
MIRRORED = f'<scale x="-1"/>{LOOK}'


def letter(pose: str) -> str:
    """Return a letter F of luminous rectangles in metres, at 1 m before a sensor of this pose."""
    place = '<rotate y="1" angle="180"/><scale value="0.0005"/>'
    return "".join(
        f'<shape type="rectangle"><transform name="to_world">{place}'
        f'<translate x="{(5.5 - column) / 1e3}" y="{(5.5 - row) / 1e3}" z="1"/>{pose}</transform>'
        f"{glow(0.8)}</shape>"
        for row, column in np.argwhere(LETTER)
    )


@pytest.mark.parametrize(("variant", "pose"), [("scalar_rgb", MIRRORED), (FAST, LOOK)])
def test_the_camera_sees_what_the_sensor_of_the_file_sees(tmp_path: Path, variant: str, pose: str) -> None:
    """A letter F, which Mitsuba's own sensor shows upright or mirrored, at the sensor's place."""
    needs(variant)
    content = letter(LOOK) + SENSOR.replace("POSE", pose) + rectangle(1, 1, 0, 0, 900, glow(0.1))
    asked = {"camera": "from file", "unit": "m"}
    described, camera = world(tmp_path, content, PINHOLE, variant=variant, world=asked)
    exact, rendering = truth(Setup(described, camera)), light(Setup(described, camera))
    activate("scalar_rgb")
    import mitsuba as mi

    itself: Any = mi.render(
        mi.load_file(str(tmp_path / "world.xml")), integrator=mi.load_dict({"type": "path"}), spp=256
    )
    picture = np.array(itself, dtype=np.float64)[..., 1] * 255
    assert (picture > 100).sum() == LETTER.sum()
    assert np.array_equal(picture > 100, LETTER) is (pose == LOOK)
    for image in (exact.image, rendering.mean.reshape(12, 12)):
        # Edges of the letter are those of pixels, on which float32 puts a few rays on the wrong side.
        np.testing.assert_allclose(image, picture, atol=8 * 204 / 256)
    np.testing.assert_allclose(exact.depth[exact.image > 100], Z, rtol=1e-4)


@pytest.mark.parametrize(("distance", "refused"), [(3e5, True), (100.0, False)])
def test_a_camera_where_float32_is_too_coarse_is_refused(tmp_path: Path, distance: float, refused: bool) -> None:
    """At 300 km steps of 2^-5 m are those of half a target; at 100 m of 2^-17 m, less than a hundredth of a pixel."""
    place = {"to_world": [{"translate": [0, distance, 0]}], "unit": "m"}
    described, camera = world(tmp_path, '<emitter type="constant"/>', variant="scalar_rgb", world=place)
    words = r"in steps of 31 mm; expected at most 1/100 of target\.pixel_pitch"
    with pytest.raises(InputError, match=words) if refused else nullcontext():
        truth(Setup(described, camera))


def test_positions_go_to_the_file_and_back() -> None:
    steps = [{"scale": 3}, {"rotate": [2, -1, 2], "angle": "40 deg"}, {"translate": [1, -2, 3]}]
    table = WorldTable.model_validate({"file": "a.xml", "to_world": steps, "unit": "cm", "scale": 0.5})
    placement, points = Placement.of_table(table), np.array([[1.0, 2, 3], [-4, 5, 60]])
    np.testing.assert_allclose(placement.to_camera(placement.to_file(points)), points, atol=1e-12)
    turn = Rotation.from_rotvec(np.radians(ANGLE) * np.array(AXIS))
    expected = 10 * (turn.apply(3 * 0.5 * points) + np.array([1.0, -2, 3]))
    np.testing.assert_allclose(placement.to_camera(points), expected, rtol=1e-12)
