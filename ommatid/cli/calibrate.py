"""Commands that yield one file of a scene: calibrate writes H, import writes a stack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import options, output
from .options import (
    Changes,
    Frames,
    Json,
    MoreImages,
    Output,
    Places,
    Points,
    PointValue,
    SceneFile,
    WorldChanges,
)

Images = Annotated[
    list[Path],
    typer.Argument(
        metavar="IMAGE...",
        help="A mosaic of the whole sensor, or a picture per sub-imager, in a folder or in order.",
    ),
]


def calibrate(
    scene: SceneFile,
    file: Output,
    frames: Frames,
    changes: WorldChanges,
    more: MoreImages = None,
    points: Points = None,
    places: Places = None,
    point_value: PointValue = 255,
    as_json: Json = False,
) -> None:
    """Find the observation matrix H alone.

    It is rendered or computed as the scene says, or with --points taken from recorded frames of a real camera.
    """
    from ommatid.pipeline.camera_files import calibrate_file, point_recording

    value = options.positive("--point-value", point_value)
    recording = point_recording(points or (), more or (), places, value, frames.settings)
    with output.progress_bar("calibrate") as progress:
        model, made, warnings = calibrate_file(scene, file, *changes.both, recording, progress)
    output.warn_all(warnings)
    output.say_done("calibrate", made, file)
    sizes = {"measurements": model.measurements, "unknowns": model.unknowns, "entries": model.entries}
    output.print_result({"file": str(file), **sizes, **model.record}, [], as_json)


def import_frames(
    scene: SceneFile, images: Images, file: Output, frames: Frames, changes: Changes, as_json: Json = False
) -> None:
    """Cut recorded frames of a real camera into a stack.

    A mosaic is the sensor seen from behind the camera, rows downwards; its numbers are taken as they are.
    """
    from ommatid.pipeline.camera_files import import_file

    description, warnings = import_file(scene, images, file, frames.settings, *changes.both)
    output.warn_all(warnings)
    output.say_done("import", True, file)
    output.print_result({"file": str(file), **description}, [], as_json)
