"""Export of a pinhole camera and its target as a plain Mitsuba scene, which Mitsuba's own command renders."""

# pyright: basic
from __future__ import annotations

from pathlib import Path

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_whole
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.setup import Setup

from .plugins import scene_of, stock_sensor, target_of, texture_of
from .variant import activate


def export(setup: Setup, path: Path) -> Path:
    """Write FILE.xml, with one sensor per sub-imager in the order of the stack, and the target's picture beside it.

    Returns the picture's path. Raises InputError for lenses that stock sensors do not have, and unless `path` ends in
    .xml; MachineError for a full disk.
    """
    scene, camera = setup.scene, setup.world.camera
    if not camera.is_ideal_pinhole:
        raise InputError(
            f"{scene.source}: stock sensors of Mitsuba are pinholes at their designed positions, so other lenses or a"
            " [camera.tolerance] cannot be exported; remove them with --set"
        )
    if path.suffix != ".xml":
        raise InputError(f"{path}: expected the name of a Mitsuba scene, ending in .xml")
    activate("scalar_rgb")
    import mitsuba as mi

    picture = path.with_name(f"{path.stem}.target.exr")
    write_truth(picture, setup.world.image)
    plugins = scene_of(target_of(camera, texture_of({"filename": picture.name})))
    for sub in camera.sub_imagers:
        name = sub.name.replace(".", "_")  # a dot would be a path into the scene
        plugins[name] = stock_sensor(camera, sub, scene.render.sampler, scene.render.sample_count)
    state = mi.parser.parse_dict(mi.parser.ParserConfig("scalar_rgb"), plugins)
    write_whole(path, lambda beside: mi.parser.write_file(state, str(beside)))
    return picture
