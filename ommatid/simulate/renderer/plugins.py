"""Mitsuba plugins of a camera and its target, as dictionaries, and their export as a plain Mitsuba scene.

Mitsuba's own command renders an exported scene. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from math import atan, degrees
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import Float32Array
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_whole
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import Sampler

from ..sampling.samplers import fitting
from .loaded import mi
from .variant import activate
from .worlds.building import BLOCK
from .worlds.placement import MILLIMETRES_AT_ORIGIN, Placement


def scene_of(target: dict[str, Any]) -> dict[str, Any]:
    """Return a Mitsuba scene with the emissive target and no sensor, without interreflections."""
    return {"type": "scene", "integrator": {"type": "path", "max_depth": 1, "block_size": BLOCK}, "target": target}


def target_of(camera: Camera, texture: dict[str, Any]) -> dict[str, Any]:
    """Return the emissive rectangle of the target, which shows its picture upright, one texel per pixel of f."""
    half = [camera.columns * camera.target_pitch / 2, camera.rows * camera.target_pitch / 2, 1.0]
    to_world = mi.ScalarTransform4f().translate([0, 0, camera.distance]).rotate([0, 1, 0], 180).scale(half)
    return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": texture}}


def stock_sensor(
    camera: Camera,
    sub: SubImager,
    sampler: Sampler,
    samples: int,
    channels: int = 1,
    far: float = 2.0,
    placement: Placement = MILLIMETRES_AT_ORIGIN,
) -> dict[str, Any]:
    """Return one sub-imager as Mitsuba's `perspective` sensor with a shifted principal point.

    far : of the far clipping plane, in distances of the target;  placement : of the camera in a world
    """
    rows, columns = sub.type.pixels
    width = float(sub.type.ratio) * columns * camera.target_pitch
    height = float(sub.type.ratio) * rows * camera.target_pitch
    x, y = camera.position(*sub.type.middle(sub.window))
    (lens_x, lens_y), z = sub.lens, camera.distance - sub.distance
    pose = mi.ScalarTransform4f().look_at([lens_x, lens_y, z], [lens_x, lens_y, z + 1], [0, 1, 0])
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": 2 * degrees(atan(width / 2 / sub.distance)),
        "near_clip": sub.distance * 1e-3 / placement.unit,
        "far_clip": sub.distance * far / placement.unit,
        "principal_point_offset_x": -(x - lens_x) / width,
        "principal_point_offset_y": -(y - lens_y) / height,
        "to_world": placement.to_world(pose, rigid=True),
        "film": film(columns, rows, channels),
        "sampler": {"type": sampler, "sample_count": fitting(sampler, samples)},
    }


def stock_sensors(camera: Camera, sampler: Sampler, channels: int, far: float, placement: Placement) -> list[Any]:
    """Create Mitsuba's sensors of all sub-imagers, in their order in the camera."""
    subs = camera.sub_imagers
    return [mi.load_dict(stock_sensor(camera, sub, sampler, 16, channels, far, placement)) for sub in subs]


def film(width: int, height: int, channels: int = 1) -> dict[str, Any]:
    """Return a film that neither filters nor rounds to half precision."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb" if channels == 3 else "luminance",
        "component_format": "float32",
    }


def black(camera: Camera, channels: int) -> dict[str, Any]:
    """Return a black picture on the target."""
    texels = np.zeros((camera.rows, camera.columns, channels), dtype=np.float32)
    return texture_of({"bitmap": mi.Bitmap(twice_if_single(texels))})


def twice_if_single(texels: Float32Array) -> Float32Array:
    """Return texels whose single row or column stands twice, which changes no picture: textures have two at least."""
    rows, columns = texels.shape[:2]
    return texels.repeat(1 + (rows == 1), axis=0).repeat(1 + (columns == 1), axis=1)


def texture_of(source: dict[str, Any]) -> dict[str, Any]:
    """Return a texture of unmodified texels: upright, not filtered, not wrapped, not read as sRGB."""
    upright = mi.ScalarTransform3f().translate([0, 1]).scale([1, -1])  # row 0 would lie at v = 0, the bottom
    return {
        "type": "bitmap",
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
        "to_uv": upright,
        **source,
    }


def export(setup: Setup, path: Path) -> Path:
    """Write FILE.xml, with one sensor per sub-imager in the order of the stack, and the target's picture beside it.

    Returns the picture's path. Raises InputError for lenses that stock sensors do not have, and unless `path` ends in
    .xml; MachineError for a full disk.
    """
    scene, camera = setup.scene, setup.world.camera
    if not camera.has_stock_sensors:
        raise InputError(
            f"{scene.source}: stock sensors of Mitsuba are pinholes at their designed positions with pixels all open,"
            " so other lenses, a [camera.tolerance] or a fill factor cannot be exported; remove them with --set"
        )
    if path.suffix != ".xml":
        raise InputError(f"{path}: expected the name of a Mitsuba scene, ending in .xml")
    activate("scalar_rgb")
    picture = path.with_name(f"{path.stem}.target.exr")
    write_truth(picture, setup.world.image)
    plugins = scene_of(target_of(camera, texture_of({"filename": picture.name})))
    for sub in camera.sub_imagers:
        name = sub.name.replace(".", "_")  # a dot would be a path into the scene
        plugins[name] = stock_sensor(camera, sub, scene.render.sampler, scene.render.sample_count)
    state = mi.parser.parse_dict(mi.parser.ParserConfig("scalar_rgb"), plugins)
    write_whole(path, lambda beside: mi.parser.write_file(state, str(beside)))
    return picture
