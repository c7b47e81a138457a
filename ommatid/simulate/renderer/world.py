"""Worlds: Mitsuba scene files behind the flat target, or instead of it.

The file has its own coordinates, in which the camera stands (`worlds.placement`). Its sensors are ignored but for the
pose of one, if the scene asks for it. Its integrator is used; without one, light is followed along paths of up to 8
segments if anything reflects it.
"""

# pyright: basic
from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import file_digest
from ommatid.runtime.printable import printable
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.world import FROM_FILE, WorldTable

from .variant import activate, ignored_samples
from .worlds.building import BLOCK, check_positions, parse_world
from .worlds.checked_world import CheckedWorld, check_world_files, reason_of
from .worlds.placement import FINEST, Placement
from .worlds.trial import try_world

TARGET = "ommatid_target"  # the rectangle's name in the world, unlikely to be used in its file
SENSORS_AT_ORIGIN = ("perspective", "thinlens", "orthographic")  # that stand there without a to_world
MOST_LIGHT = 1e15  # whose square float32 still holds
NOISE = 1e-6  # of the largest reading, by which others may be below 0
DEEPEST = 8  # segments of a path, if the file has no integrator


@dataclass(frozen=True)
class StagedWorld:
    """A world with the target in it as a Mitsuba scene, its integrator, and where the camera stands in it.

    direct_only : True if interreflections are left out, since nothing reflects;  sensors : number of them in the file
    where : start of messages;  signed : True if a picture on the target may have negative values
    """

    scene: Any
    integrator: Any
    placement: Placement
    sensors: int
    direct_only: bool = False
    where: str = ""
    signed: bool = False

    def distance(self, origin: tuple[Any, Any, Any], direction: tuple[Any, Any, Any], far: float) -> Any:
        """Return the distance along z, mm, of the surface that rays meet first, `far` where they meet none."""
        import drjit as dr
        import mitsuba as mi

        along = dr.normalize(mi.Vector3f(*direction))
        ray = mi.Ray3f(*self.placement.carry(mi.Point3f(*origin), along))
        met = self.scene.ray_intersect_preliminary(ray, coherent=False)
        return dr.minimum(dr.select(met.is_valid(), met.t * (along.z * self.placement.unit), far), far)

    def sound_readings(self, readings: FloatArray) -> FloatArray:
        """Return readings of the world, at any scale. Raises InputError for those that no light yields."""
        if ignored_samples() or not np.isfinite(readings).all():
            got = "samples that are negative or not finite"
        elif readings.size and np.abs(readings).max() > MOST_LIGHT:
            got = f"{np.abs(readings).max():.3g}"
        elif not self.signed and readings.size and readings.min() < -NOISE * np.abs(readings).max():
            got = f"{readings.min():.3g}"
        else:
            return readings
        raise InputError(
            f"{self.where}: expected readings of 0 to {MOST_LIGHT:g}, where white is 255, got {got}; correct its lamps"
            " and pictures"
        )


def world_of(scene: Scene) -> WorldTable:
    """Return the [world] of a scene. Raises ValueError if it has none."""
    if scene.world is None:
        raise ValueError(f"{scene.source}: expected a scene with a [world], got one without")
    return scene.world


def path_of(scene: Scene) -> Path:
    """Return the world's file on this machine. Raises ValueError for a scene without a [world]."""
    return scene.world_copy or Path(world_of(scene).file)


def white_of(scene: Scene) -> float:
    """Return the radiance of a value of 255. Raises ValueError if it is still to be found."""
    white = world_of(scene).white
    if isinstance(white, str):
        raise ValueError(f"{scene.source}: expected world.white as a number, got '{white}'")
    return white


def checked(scene: Scene) -> CheckedWorld:
    """Return the checked text of the world's file and of those that it includes. Raises InputError."""
    return check_world_files(path_of(scene), f"{scene.source}: world.file", scene.allows_outside)


def files(scene: Scene) -> list[Path]:
    """Return the world's file and those that it names. Raises InputError for one that may not be read."""
    return checked(scene).files


def describe(scene: Scene) -> dict[str, Any]:
    """Describe a world for a fingerprint, by SHA-256 of its file and of those that it names. Raises InputError."""
    world = world_of(scene)
    folder = path_of(scene).parent
    sums = {os.path.relpath(path, folder): file_digest(path) for path in files(scene)}
    place, has_target = world.describe_place(), scene.target.image is not None
    return {"white": world.white, "target": has_target, "files": sums, **({"place": place} if place else {})}


def stage(scene: Scene, variant: str, target: dict[str, Any] | None) -> StagedWorld:
    """Build the world, with the target's rectangle (a Mitsuba shape as a dictionary) in it, if there is one.

    Raises InputError for a file that Mitsuba cannot build a scene from, for a world without an emitter, and for a file
    that does not state where the camera stands if it is asked.
    """
    activate(variant)
    import mitsuba as mi

    where, world = f"{scene.source}: world.file: {printable(path_of(scene))}", checked(scene)
    try_world(world, variant, where)
    try:
        parsed = parse_world(world.text, variant)
        placement = _placement(scene, parsed.sensors, where)
        if target is not None:
            shape: Any = mi.load_dict({**target, "to_world": placement.to_world(target["to_world"])})
            shape.set_id(TARGET)  # by which its parameters are identified
            parsed.state.root.props[TARGET] = shape
        built = parsed.build()
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{where} is no scene that Mitsuba can build: {reason_of(str(error), world)}") from error
    check_positions(built, where)
    if not built.emitters():
        raise InputError(f"{where} has no emitter, so the image is black; add one, such as <emitter type='constant'/>")
    direct_only, integrator = False, built.integrator()
    if not parsed.has_integrator:
        direct_only = not (scene.render.complete or has_interreflections(built))
        path = {"type": "path", "max_depth": 1 if direct_only else DEEPEST, "block_size": BLOCK}
        integrator = mi.load_dict(path)
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise InputError(f"{where}: its integrator does not follow rays from a camera; expected one such as 'path'")
    more = integrator.aov_names()
    if more:
        words = printable(", ".join(more), 60)
        raise InputError(
            f"{where}: its integrator returns {len(more)} more channels ({words}); expected the radiance alone, as of"
            " 'path': remove 'aov' and 'moment'"
        )
    signed = target is not None
    return StagedWorld(built, integrator, placement, len(parsed.sensors), direct_only, where, signed)


def _placement(scene: Scene, sensors: list[Any], where: str) -> Placement:
    """Return where the camera stands in a file with these sensors. Raises InputError."""
    table = world_of(scene)
    placement = Placement.of_table(table) if table.camera != FROM_FILE else _pose_of_sensor(table, sensors, where)
    if not placement.spacing <= scene.target.pixel_pitch / FINEST:  # also where float32 overflows
        raise InputError(
            f"{where}: the camera stands so far from the file's origin that float32 moves it in steps of"
            f" {placement.spacing:.2g} mm; expected at most 1/{FINEST} of target.pixel_pitch: move it nearer"
        )
    return placement


def _pose_of_sensor(table: WorldTable, sensors: list[Any], where: str) -> Placement:
    import mitsuba as mi

    asks = f"{where}: world.camera = '{FROM_FILE}' takes the pose of the file's sensor"
    if len(sensors) != 1:
        remedy = "leave one in the file" if sensors else "add one, or state world.to_world instead"
        raise InputError(f"{asks}: expected one sensor, got {len(sensors)}; {remedy}")
    (props,) = sensors
    has_pose = "to_world" in props and props.type("to_world") == mi.Properties.Type.Transform
    if not has_pose and props.plugin_name() not in SENSORS_AT_ORIGIN:
        raise InputError(f"{asks}: expected one with a to_world, got a '{props.plugin_name()}' without; add it there")
    matrix = np.array(props["to_world"].matrix, dtype=np.float64) if has_pose else np.eye(4)
    placement = Placement.of_sensor(matrix, table)
    if placement is None:
        raise InputError(
            f"{asks}: expected a to_world that moves and rotates, got one that shears or stretches; correct it there"
        )
    return placement


def has_interreflections(world: Any) -> bool:
    """Return True if light may reach the camera of a Mitsuba scene on other paths than directly from an emitter.

    False only if every surface is known to be black: anything else may reflect or transmit light.
    """
    import mitsuba as mi

    for shape in world.shapes():
        if shape.bsdf() is None:
            return True
        values = dict(mi.traverse(shape.bsdf()))
        black = set(values) == {"reflectance.value"} and not np.any(np.array(values["reflectance.value"]))
        if not black or shape.interior_medium() is not None or shape.exterior_medium() is not None:
            return True
    return False
