"""A world behind the flat target, or instead of it: any Mitsuba scene file.

The file is in millimetres, the camera at its origin looking along +z with +y up. Its own sensors are not used, its
integrator is; without one, light bounces along paths of up to 8 segments where anything reflects it.
"""

# pyright: basic
from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene, WorldTable

from .plugins import BLOCK
from .variant import activate

TARGET = "ommatid_target"  # the rectangle's name in the world: a name that its file will not have given
BACKWARDS = "ptracer"  # the integrator that starts at the lamps, and takes no block size
DEEPEST = 8  # segments of a path, where the file says nothing


@dataclass(frozen=True)
class StagedWorld:
    """A world with the target in it as Mitsuba has it, and the integrator that light is followed by in it.

    straight : whether light that bounces was left out, since nothing reflects any
    """

    scene: Any
    integrator: Any
    straight: bool = False


def world_of(scene: Scene) -> WorldTable:
    """The world of a scene. Raises ValueError where it has none."""
    if scene.world is None:
        raise ValueError(f"{scene.source}: expected a scene with a [world], got one without")
    return scene.world


def files(scene: Scene) -> list[Path]:
    """The world's file and those that it names and that are found beside it; not those that `$variables` name.

    Raises InputError if there is no such file or it is not XML.
    """
    path = Path(world_of(scene).file)
    found, waiting = [path], [path]
    while waiting:
        for name in _named(waiting.pop(), scene):
            beside = path.parent / name  # also of those in included files, as Mitsuba looks for them
            if beside.is_file() and beside not in found:
                found.append(beside)
                if beside.suffix.lower() == ".xml":
                    waiting.append(beside)
    return found


def _named(path: Path, scene: Scene) -> list[str]:
    where = f"{scene.source}: world.file"
    try:
        elements = ElementTree.parse(path).getroot().iter()
    except FileNotFoundError as error:
        raise InputError(f"{where}: there is no Mitsuba scene {path}; name one, beside the scene file") from error
    except (OSError, ValueError, LookupError) as error:
        raise InputError(f"{where}: {path} could not be read as a Mitsuba scene ({error})") from error
    except ElementTree.ParseError as error:
        raise InputError(f"{where}: {path} is not valid XML: {error}; mend it there") from error
    names = [
        element.get("value" if element.tag == "string" else "filename")
        for element in elements
        if element.tag == "include" or (element.tag == "string" and element.get("name") == "filename")
    ]
    return [name for name in names if name]


def describe(scene: Scene) -> dict[str, Any]:
    """What values depend on of a world: SHA-256 of its file and of those that it names. Raises InputError."""
    world = world_of(scene)
    folder = Path(world.file).parent
    sums: dict[str, str] = {}
    for path in files(scene):
        with path.open("rb") as stream:
            sums[os.path.relpath(path, folder)] = hashlib.file_digest(stream, "sha256").hexdigest()
    return {"white": world.white, "target": scene.target.image is not None, "files": sums}


def stage(scene: Scene, variant: str, target: Any | None) -> StagedWorld:
    """Build the world, with the target's rectangle (a Mitsuba shape) in it, if there is one.

    Raises InputError for a file that Mitsuba cannot make a scene of, and where nothing shines.
    """
    activate(variant)
    import mitsuba as mi

    file = world_of(scene).file
    where = f"{scene.source}: world.file: {file}"
    files(scene)  # its errors are clearer than Mitsuba's
    config = mi.parser.ParserConfig(variant)
    try:
        state = mi.parser.parse_file(config, file)
        if state.root.type != mi.ObjectType.Scene:
            raise InputError(f"{where} holds a single {state.root.type.name.lower()}; expected a whole <scene>")
        followed = _adapt(state, Path(file).parent)
        mi.parser.transform_all(config, state)
        if target is not None:
            target.set_id(TARGET)  # by which its parameters are found again
            state.root.props[TARGET] = target
        built: Any = mi.parser.instantiate(config, state)
    except (RuntimeError, TypeError) as error:
        what = re.sub(r"^\[\w+\.cpp:\d+\] ", "", " ".join(str(error).split()))
        raise InputError(f"{where} is no scene that Mitsuba can build: {what}") from error
    if not built.emitters():
        raise InputError(f"{where} has no emitter, so all is black; add one, such as <emitter type='constant'/>")
    if not followed:
        straight = not (scene.render.complete or bounces(built))
        path = {"type": "path", "max_depth": 1 if straight else DEEPEST, "block_size": BLOCK}
        return StagedWorld(built, mi.load_dict(path), straight)
    if not isinstance(built.integrator(), mi.SamplingIntegrator):
        raise InputError(f"{where}: its integrator does not follow rays from a camera; expected one such as 'path'")
    return StagedWorld(built, built.integrator())


def _adapt(state: Any, folder: Path) -> bool:
    """Drop the sensors, name files by their whole path, and say whether there is an integrator."""
    import mitsuba as mi

    kinds = mi.Properties.Type
    followed = False
    root = state.root.props
    for key in list(root.keys()):
        if root.type(key) == kinds.ResolvedReference:
            kind = state.nodes[root[key].index()].type
            followed |= kind == mi.ObjectType.Integrator
            if kind == mi.ObjectType.Sensor:
                del root[key]
    for node in state.nodes:
        props = node.props
        if "filename" in props and props.type("filename") == kinds.String:
            beside = folder / props["filename"]
            if beside.is_file():
                props["filename"] = str(beside)
        if node.type == mi.ObjectType.Integrator and props.plugin_name() != BACKWARDS:
            props["block_size"] = BLOCK
    return followed


def bounces(world: Any) -> bool:
    """Whether light may reach the camera of a Mitsuba scene by another way than straight from an emitter.

    False only where every surface is known to be black: anything else may reflect, or let through what is behind it.
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
