"""What the camera sees of a world: the surfaces that its pixels meet, their distances, and the radiance of white.

Rays through the middles of lenses, of a few pixels of each sub-imager, cost next to nothing and tell a world in another
unit, or one beside the camera, before anything is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import log
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import fingerprint
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Scene, with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.world import FROM_FILE, MILLIMETRES, WorldTable

from .renderer.variant import choose
from .sampling.passes import Plan

SUB_IMAGERS, SIDE = 64, 4  # from which views are followed, at most, and how many views along each side of one
COARSE, SAMPLES = 48, 64  # pixels along the longer side, and samples of each, of the picture that finds white
BRIGHT = 99.5  # percentile of that picture that is white
ENOUGH = 0.5  # share of views that have to meet a surface


@dataclass(frozen=True)
class WorldView:
    """What the camera sees of a world; lengths are millimetres, +x to the camera's left, +y up, +z ahead.

    views : number of views that were followed;  met : how many of them meet a surface
    depths : nearest, median and farthest distance along z of those surfaces; None if there are none
    box : least and largest x, y and z of all surfaces; None if there are none
    sky : True if light comes from where there is no surface
    sensors : number of sensors in the file;  white : radiance of a value of 255, 0 if none was found
    fitting_unit : in which the camera would see the world, if it does not; None if there is none
    has_picture : True if the target has a picture, which is left out here
    """

    views: int
    met: int
    depths: tuple[float, float, float] | None
    box: tuple[tuple[float, ...], tuple[float, ...]] | None
    sky: bool
    sensors: int
    white: float
    fitting_unit: str | None
    has_picture: bool

    def describe(self) -> dict[str, Any]:
        """Describe the view in JSON's types."""
        nearest, median, farthest = self.depths or (None, None, None)
        return {
            "views": self.views,
            "views_that_meet_a_surface": self.met,
            "nearest": nearest,
            "median": median,
            "farthest": farthest,
            "box": None if self.box is None else [list(end) for end in self.box],
            "sky": self.sky,
            "sensors": self.sensors,
            "white": self.white,
            "has_picture": self.has_picture,
        }


def rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Tabulate the description of a view."""
    met, views, box = description["views_that_meet_a_surface"], description["views"], description["box"]
    others = "; the others see the sky" if description["sky"] and met < views else ""
    name = "what the camera sees" + (" without the picture" if description["has_picture"] else "")
    table = [(name, f"a surface in {met} of {views} views of sensor pixels{others}")]
    if met:
        nearest, median, farthest = (description[name] for name in ("nearest", "median", "farthest"))
        words = f"{nearest:.5g} to {farthest:.5g} mm away, half of them nearer than {median:.5g} mm"
        table.append(("surfaces in view", words))
    if box is not None:
        table.append(("box around all surfaces", f"{_box_words(box)} (+x left, +y up, +z ahead)"))
    return [*table, ("radiance of a value of 255", f"{description['white']:.5g}")]


_known: dict[str, WorldView] = {}


def world_view(setup: Setup) -> WorldView:
    """Look at the world of a scene; computed once per process. Raises InputError for one that cannot be built."""
    from .renderer.world import describe, world_of
    from .renderer.worlds.building import box_of, depths_met, has_surroundings

    scene, camera, table = setup.scene, setup.camera, world_of(setup.scene)
    variant = choose(scene.render.variant)  # before Mitsuba is loaded
    from .renderer.renderer import Renderer

    key = fingerprint([describe(scene), camera.describe(), scene.render.model_dump(mode="json"), variant])
    if key in _known:
        return _known[key]
    alone = with_tables(
        scene, world=table.model_copy(update={"white": 1.0}), target=scene.target.model_copy(update={"image": None})
    )
    renderer = Renderer(coarse_camera(camera), variant, scene.render.sampler, world=alone)
    world: Any = renderer.staged
    origins, directions = views(camera)
    depths = depths_met(world.scene, world.placement, origins, directions)
    met, box = depths[np.isfinite(depths)], box_of(world.scene, world.placement)
    view = WorldView(
        views=depths.size,
        met=met.size,
        depths=(float(met.min()), float(np.median(met)), float(met.max())) if met.size else None,
        box=None if box is None else (tuple(box[0].tolist()), tuple(box[1].tolist())),
        sky=has_surroundings(world.scene),
        sensors=world.sensors,
        white=table.white if isinstance(table.white, float) else _brightest(renderer, scene.render.seed),
        fitting_unit=None if sees_enough(camera, depths) else _fitting_unit(world, camera, table),
        has_picture=scene.target.image is not None,
    )
    _known[key] = view
    return view


def rendered_world(setup: Setup) -> Scene | None:
    """Return the scene whose world is rendered, with white as a number; None without a world. Raises InputError."""
    scene = setup.scene
    if scene.world is None or isinstance(scene.world.white, float):
        return None if scene.world is None else scene
    white = world_view(setup).white
    _check_white(scene, white)
    return with_tables(scene, world=scene.world.model_copy(update={"white": white}))


def check_world(setup: Setup) -> WorldView:
    """Return what the camera sees of a world.

    Raises InputError if it sees next to nothing, no light, or a world so near that the lenses have no view in common.
    A picture on the target is seen in any case, so that a world around it may be anywhere.
    """
    view, scene = world_view(setup), setup.scene
    if scene.target.image is None and view.box is not None:
        _check_surfaces(setup, view)
    _check_white(scene, view.white)
    return view


def _check_surfaces(setup: Setup, view: WorldView) -> None:
    from .renderer.world import world_of

    scene = setup.scene
    where = f"{scene.source}: world.file: {world_of(scene).file}"
    if view.depths is None or (not view.sky and view.met < ENOUGH * view.views):
        raise InputError(_unseen(where, view, setup.camera, world_of(scene)))
    if view.met >= ENOUGH * view.views and _beyond_target(setup.camera, view.depths[1]):
        raise InputError(_too_near(where, view, setup.camera, world_of(scene), view.depths[1]))


def sees_enough(camera: Camera, depths: FloatArray) -> bool:
    """Return True if enough views meet a surface, of which opposite lenses of the array see a part in common."""
    met = depths[np.isfinite(depths)]
    return met.size >= ENOUGH * depths.size and not _beyond_target(camera, float(np.median(met)))


def displacement(camera: Camera, depth: float) -> FloatArray:
    """Return by how many rows and columns of f opposite lenses of the array see a point at `depth` displaced."""
    across, down = np.ptp([sub.lens for sub in camera.sub_imagers], axis=0)
    return np.array([down, across]) * abs(camera.distance / depth - 1) / camera.target_pitch


def _beyond_target(camera: Camera, depth: float) -> bool:
    return bool(np.any(displacement(camera, depth) > camera.shape))


def _unseen(where: str, view: WorldView, camera: Camera, table: WorldTable) -> str:
    half = [camera.columns * camera.target_pitch / 2, camera.rows * camera.target_pitch / 2]
    seen = ", ".join(f"{axis} {-end:.4g} to {end:.4g}" for axis, end in zip("xy", half, strict=True))
    return (
        f"{where}: {view.met} of {view.views} views of sensor pixels meet a surface, expected half or more: the camera"
        f" stands at 0, 0, 0, looks along +z and sees {seen} mm at {camera.distance:.4g} mm, and the world's bounding"
        f" box is {_box_words(view.box)}; {_remedy(view, table)}"
    )


def _remedy(view: WorldView, table: WorldTable) -> str:
    unit = "correct world.unit"
    if view.fitting_unit is not None:
        unit = f"set world.unit = '{view.fitting_unit}' if the file is in {view.fitting_unit}"
    if table.camera is not None:
        return f"{unit}, or turn the file's sensor"
    sensor = f", or take world.camera = '{FROM_FILE}'" if view.sensors == 1 else ""
    return f"{unit}, or move the world with world.to_world{sensor}"


def _fitting_unit(world: Any, camera: Camera, table: WorldTable) -> str | None:
    """Return the unit in which the camera sees the world with surfaces closest to the target's plane, if any."""
    from .renderer.worlds.building import depths_met

    found = dict[str, float]()
    for unit, millimetres in MILLIMETRES.items():
        placement = replace(world.placement, unit=world.placement.unit * millimetres / MILLIMETRES[table.unit])
        depths = depths_met(world.scene, placement, *views(camera))
        if sees_enough(camera, depths):
            found[unit] = abs(log(float(np.median(depths[np.isfinite(depths)])) / camera.distance))
    return min(found, key=lambda unit: found[unit]) if found else None


def _too_near(where: str, view: WorldView, camera: Camera, table: WorldTable, median: float) -> str:
    return (
        f"{where}: half of the surfaces that the camera sees are nearer than {median:.4g} mm, and the target's plane is"
        f" at {camera.distance:.4g} mm: opposite lenses of the array see them displaced by"
        f" {displacement(camera, median).max():.3g} pixels of f, more than the whole target, and the world's bounding"
        f" box is {_box_words(view.box)}; {_remedy(view, table)}"
    )


def _box_words(box: Sequence[Sequence[float]] | None) -> str:
    if box is None:
        return "empty"
    return ", ".join(f"{axis} {least:.5g} to {most:.5g}" for axis, least, most in zip("xyz", *box, strict=True)) + " mm"


def views(camera: Camera, sides: tuple[int, int] = (SIDE, SIDE)) -> tuple[FloatArray, FloatArray]:
    """Return origins and directions, (n, 3), of rays from the middles of lenses to a grid of points of their views."""
    every = max(1, -(-len(camera.sub_imagers) // SUB_IMAGERS))
    shares = [(np.arange(side) + 0.5) / side for side in sides]
    origins, directions = list[FloatArray](), list[FloatArray]()
    for sub in camera.sub_imagers[::every]:
        places = (float(sub.type.ratio) * count * share for count, share in zip(sub.type.pixels, shares, strict=True))
        down, across = np.meshgrid(*places, indexing="ij")
        x = (camera.columns / 2 - float(sub.window[1]) - across.ravel()) * camera.target_pitch
        y = (camera.rows / 2 - float(sub.window[0]) - down.ravel()) * camera.target_pitch
        start = np.tile([*sub.lens, camera.distance - sub.distance], (x.size, 1))
        origins.append(start)
        directions.append(np.stack([x, y, np.full(x.size, camera.distance)], axis=1) - start)
    return np.concatenate(origins), np.concatenate(directions)


def ideal_camera(camera: Camera) -> Camera:
    """Return a pinhole in the array's centre with a sensor pixel per pixel of f."""
    lens_type = LensType("truth", Fraction(1), (1, 1), camera.shape, (Fraction(1), Fraction(1)), (0, 0))
    return replace(
        camera, types=(lens_type,), wavelength=None, tolerance=None, lens_columns=None, walls=True, sensor_distance=None
    )


def coarse_camera(camera: Camera) -> Camera:
    """Return a pinhole in the array's centre that sees the target with COARSE pixels along its longer side, at most."""
    times = -(-max(camera.shape) // COARSE)
    rows, columns = (max(1, count // times) for count in camera.shape)
    return ideal_camera(replace(camera, rows=rows, columns=columns, target_pitch=camera.target_pitch * times, detail=1))


def _brightest(renderer: Any, seed: int) -> float:
    """Return the radiance that all but the brightest pixels of a coarse picture stay below; 0 if there is no light."""
    radiance = renderer.mean_of_passes("white", seed, Plan(1, SAMPLES))[0] / WHITE  # where a radiance of 1 is white
    white = float(np.percentile(radiance, BRIGHT))
    return white if 0 < white < np.inf else 0.0


def _check_white(scene: Scene, white: float) -> None:
    from .renderer.world import world_of

    if not white:
        raise InputError(
            f"{scene.source}: world.file: {world_of(scene).file}: world.white 'auto' needs light that the camera sees,"
            " got a black view; add lamps to the file, or state world.white"
        )
