"""Commands on a scene file or the installation itself: show, export, init, schema and doctor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ommatid.runtime.errors import InputError
from ommatid.scenes.tables.gallery import gallery_names

from . import options, output
from .options import (
    SCREEN,
    AllowOutside,
    FigureFormats,
    FigureResolution,
    Json,
    Lenses,
    Output,
    SceneFile,
    Sets,
)

FigureFile = Annotated[
    Path | None, typer.Option("--figure", metavar="FILE", help="Write a drawing of the camera: .png, .svg or .pdf.")
]
NewFile = Annotated[Path | None, typer.Argument(metavar="FILE", help="The scene file to write.", show_default=False)]
Source = Annotated[
    str,
    typer.Option(
        "--from", metavar="NAME", help="Scene of the gallery to copy, with its files.", autocompletion=gallery_names
    ),
]
ListScenes = Annotated[bool, typer.Option("--list", help="List the scenes of the gallery with their titles.")]


def show(
    scene: SceneFile,
    sets: Sets = None,
    lens: Lenses = "",
    allow_outside: AllowOutside = False,
    figure: FigureFile = None,
    figure_formats: FigureFormats = "",
    figure_resolution: FigureResolution = SCREEN,
    as_json: Json = False,
) -> None:
    """Show the camera in the terms of optics, the plan, and the skipped effects."""
    from ommatid.pipeline.descriptions import describe_scene, focus_curves
    from ommatid.pipeline.sections import scene_sections
    from ommatid.scenes.formats.picture import conversions
    from ommatid.scenes.scene import read

    described = read(scene, options.changes(sets, allow_outside), options.lens_names(lens))
    output.warn_all(conversions(described))
    description = describe_scene(described)
    if figure is not None:
        from ommatid.figures.camera_drawing import write_drawing
        from ommatid.figures.saving import figure_format

        files = options.figure_files(figure_formats, figure_resolution, figure_format(figure))
        for path in write_drawing(figure, described, files, focus_curves(described)):
            output.say(f"{path}: written")
    output.print_result(description, scene_sections(description), as_json)
    output.warn_all(description["warnings"])


def export(scene: SceneFile, file: Output, sets: Sets = None, lens: Lenses = "", as_json: Json = False) -> None:
    """Write a plain Mitsuba scene of stock sensors."""
    from ommatid.pipeline.stages import export_scene

    description = export_scene(scene, file, options.changes(sets), options.lens_names(lens))
    files = f"{file} and {description['picture']}: {len(description['sensors'])} sensors"
    output.say(f"{files}; render one with: mitsuba -m scalar_rgb -s 0 {file}")
    output.print_result(description, [], as_json)


def init(
    file: NewFile = None, source: Source = "starter", list_scenes: ListScenes = False, as_json: Json = False
) -> None:
    """Write a scene file to start from."""
    from ommatid.scenes.tables.gallery import gallery_titles, write_starter

    if list_scenes:
        titles = gallery_titles()
        width = max(map(len, titles))
        scenes = [{"name": name, "title": title} for name, title in titles.items()]
        lines = [f"{name:{width}}  {title}" for name, title in titles.items()]
        output.print_json(scenes) if as_json else output.print_lines(lines)
        return
    if file is None:
        raise InputError("init: expected the name of the scene file to write, such as mine.toml, got none")
    written = [str(path) for path in write_starter(file, source)]
    output.say(f"{', '.join(written)}: written; next: ommatid run {file} -o out")
    output.print_result({"file": str(file), "files": written}, [], as_json)


def schema(as_json: Json = False) -> None:
    """Print the JSON Schema of scene files."""
    del as_json  # the schema is one JSON document in any case
    from ommatid.scenes.scene import Scene

    output.print_json(Scene.model_json_schema())


def doctor(as_json: Json = False) -> None:
    """Test the rendering backends, and say how to repair them."""
    from ommatid.pipeline.descriptions import describe_backends
    from ommatid.pipeline.sections import backend_sections

    description = describe_backends()
    output.print_result(description, backend_sections(description), as_json, description["advice"])
