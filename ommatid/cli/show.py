"""Commands on a scene file or the installation itself: show, export, init, schema and doctor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ommatid.runtime.errors import InputError
from ommatid.scenes.tables.gallery import gallery_names

from . import output
from .options import Changes, Json, Output, Printing, SceneFile, SceneOrModel, WorldChanges

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


def show(scene: SceneFile, changes: WorldChanges, printing: Printing, figure: FigureFile = None) -> None:
    """Show the camera in the terms of optics, and what is left out; with -v why, and the plan."""
    from ommatid.analysis import summary
    from ommatid.pipeline.sections import describe_scene, focus_curves, scene_sections
    from ommatid.scenes.formats.picture import conversions
    from ommatid.scenes.scene import read

    detail = printing.detail
    described = read(scene, *changes.both)
    output.warn_all(conversions(described))
    description = describe_scene(described)
    if figure is not None:
        from ommatid.figures.camera_drawing import write_drawing

        write_drawing(figure, described, focus_curves(described))
        output.say(f"{figure}: written")
    if detail is None:
        output.print_json(description)
    elif detail == "table":
        output.print_tables(scene_sections(description))
    else:
        output.print_lines(summary.short_lines(description))
        if detail == "summary":
            output.print_tables([summary.short_section(description)])
            output.print_lines([summary.left_out_line(description)])
    output.warn_all(description["warnings"])


def export(source: SceneOrModel, file: Output, changes: Changes, as_json: Json = False) -> None:
    """Write a plain Mitsuba scene, or H of a model as a matrix for scipy.sparse.load_npz."""
    from ommatid.pipeline.camera_files import export_matrix
    from ommatid.pipeline.stages import export_scene

    if source.suffix == ".npz":
        if any(changes.both):
            raise InputError(f"{source}: --set and --lens change scenes, got a model; leave them out")
        description = {"file": str(file), **export_matrix(source, file)}
        output.say_done("export", True, file)
    else:
        description = export_scene(source, file, *changes.both)
        files = f"{file} and {description['picture']}: {len(description['sensors'])} sensors"
        output.say(f"{files}; render one with: mitsuba -m scalar_rgb -s 0 {file}")
    output.print_result(description, [], as_json)


def init(file: NewFile = None, source: Source = "starter", as_json: Json = False) -> None:
    """Write a scene file to start from; without FILE list the gallery."""
    from ommatid.scenes.tables.gallery import gallery_titles, write_starter

    if file is None:
        titles = gallery_titles()
        width = max(map(len, titles))
        scenes = [{"name": name, "title": title} for name, title in titles.items()]
        lines = [f"{name:{width}}  {title}" for name, title in titles.items()]
        output.print_json(scenes) if as_json else output.print_lines(lines)
        output.say("these are scenes of the gallery; write one by: ommatid init mine.toml --from tile19")
        return
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
    from ommatid.pipeline.sections import backend_sections, describe_backends

    description = describe_backends()
    output.print_result(description, backend_sections(description), as_json, description["advice"])
