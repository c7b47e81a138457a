"""Commands on a scene file or the installation itself: show, export, init, schema and doctor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import options, output
from .options import Complete, Json, Lenses, Output, SceneFile, Sets

NewFile = Annotated[Path, typer.Argument(metavar="FILE", help="The scene file to write.")]


def show(
    scene: SceneFile, sets: Sets = None, lens: Lenses = "", complete: Complete = False, as_json: Json = False
) -> None:
    """Show the camera in the terms of optics, the plan, and the skipped effects."""
    from ommatid.pipeline.descriptions import describe_scene
    from ommatid.pipeline.sections import scene_sections
    from ommatid.scenes.scene import read

    description = describe_scene(read(scene, options.changes(sets, complete), options.lens_names(lens)))
    output.print_result(description, scene_sections(description), as_json)
    for sentence in description["warnings"]:
        output.say(f"warning: {sentence}")


def export(scene: SceneFile, file: Output, sets: Sets = None, lens: Lenses = "", as_json: Json = False) -> None:
    """Write a plain Mitsuba scene of stock sensors."""
    from ommatid.pipeline.stages import export_scene

    description = export_scene(scene, file, options.changes(sets), options.lens_names(lens))
    files = f"{file} and {description['picture']}: {len(description['sensors'])} sensors"
    output.say(f"{files}; render one with: mitsuba -m scalar_rgb -s 0 {file}")
    output.print_result(description, [], as_json)


def init(file: NewFile, as_json: Json = False) -> None:
    """Write a scene file to start from."""
    from ommatid.scenes.tables.gallery import write_starter

    write_starter(file)
    output.say(f"{file}: written; next: ommatid run {file} -o out")
    output.print_result({"file": str(file)}, [], as_json)


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
