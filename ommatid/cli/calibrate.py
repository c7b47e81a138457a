"""Commands that yield one file of a scene: calibrate writes H, import writes a stack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import options, output
from .options import (
    AllowOutside,
    Dark,
    Flat,
    FlatValue,
    Json,
    Lenses,
    MoreImages,
    Origin,
    Output,
    Places,
    Points,
    PointValue,
    SceneFile,
    Sets,
    Upright,
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
    more: MoreImages = None,
    points: Points = None,
    places: Places = None,
    point_value: PointValue = 255,
    dark: Dark = None,
    flat: Flat = None,
    flat_value: FlatValue = 255,
    origin: Origin = "",
    upright: Upright = None,
    sets: Sets = None,
    lens: Lenses = "",
    allow_outside: AllowOutside = False,
    as_json: Json = False,
) -> None:
    """Find the observation matrix H alone.

    It is rendered or computed as the scene says, or with --points taken from recorded frames of a real camera.
    """
    from ommatid.pipeline.camera_files import calibrate_file, point_recording

    settings = options.acquisition(dark, flat, flat_value, origin, upright)
    value = options.positive("--point-value", point_value)
    recording = point_recording(points or (), more or (), places, value, settings)
    asked = options.changes(sets, allow_outside), options.lens_names(lens)
    with output.progress_bar("calibrate") as progress:
        model, made, warnings = calibrate_file(scene, file, *asked, recording, progress)
    output.warn_all(warnings)
    output.say_done("calibrate", made, file)
    sizes = {"measurements": model.measurements, "unknowns": model.unknowns, "entries": model.entries}
    output.print_result({"file": str(file), **sizes, **model.record}, [], as_json)


def export_model(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A model that calibrate or run wrote (.npz).")],
    file: Output,
    as_json: Json = False,
) -> None:
    """Write the observation matrix H of a model as a matrix for scipy.sparse.load_npz."""
    from ommatid.pipeline.camera_files import export_matrix

    description = export_matrix(model, file)
    output.say_done("export-model", True, file)
    output.print_result({"file": str(file), **description}, [], as_json)


def import_frames(
    scene: SceneFile,
    images: Images,
    file: Output,
    dark: Dark = None,
    flat: Flat = None,
    flat_value: FlatValue = 255,
    origin: Origin = "",
    upright: Upright = None,
    sets: Sets = None,
    lens: Lenses = "",
    as_json: Json = False,
) -> None:
    """Cut recorded frames of a real camera into a stack.

    A mosaic is the sensor seen from behind the camera, rows downwards; its numbers are taken as they are.
    """
    from ommatid.pipeline.camera_files import import_file

    settings = options.acquisition(dark, flat, flat_value, origin, upright)
    asked = options.changes(sets), options.lens_names(lens)
    description, warnings = import_file(scene, images, file, settings, *asked)
    output.warn_all(warnings)
    output.say_done("import", True, file)
    output.print_result({"file": str(file), **description}, [], as_json)
