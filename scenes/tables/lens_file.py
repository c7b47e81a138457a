"""Lenses as they are written down: a surface a row, from the target to the sensor.

Two forms of file are read. TOML holds what a scene file holds, `surfaces = [{radius = "1 mm", thickness = "0.5 mm",
glass = "N-BK7", semi_diameter = "0.2 mm"}, ...]`, and a `title` if one wants. Any other file is taken for the text that
PBRT's realistic camera reads: rows of radius, thickness, index of refraction and diameter, in millimetres, where what
follows a # is a comment and a number alone in the first row is the focal length. PBRT's radii have our sign, positive
where the centre of curvature lies towards the film. Its index 0 is air; its last thickness, to the film, is left
out, because the magnification says where the sensor stands; a radius 0 is a plane, the aperture stop where there is air
on both sides of it or its index is 0.

Source: M. Pharr, W. Jakob, G. Humphreys, Physically Based Rendering, section 6.4 (third edition).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError

from ommatid.runtime.errors import InputError, shortened

from . import glass, toml
from .camera import CameraTable, Surface
from .messages import explain
from .table import Table
from .units import pair

COLUMNS = "radius, thickness, index of refraction, diameter"


class LensFile(Table):
    """A lens by itself."""

    title: str = ""
    surfaces: Annotated[tuple[Surface, ...], BeforeValidator(pair), Field(min_length=1)]


def read_lens(path: Path) -> tuple[Surface, ...]:
    """The surfaces of a lens from a file in TOML (.toml) or in PBRT's text form (any other ending).

    Raises InputError that names the file, the row or the key, what was expected and what came.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such lens file; expected one beside the scene file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: could not be read as a lens file ({error})") from error
    surfaces = _from_toml(text, path) if path.suffix == ".toml" else _from_rows(text, path)
    stops = sum(surface.stop for surface in surfaces)
    if stops > 1:
        raise InputError(f"{path}: expected one aperture stop at most, got {stops}; mark the smallest alone")
    return surfaces


def with_surfaces(camera: CameraTable, source: Path) -> CameraTable:
    """The camera's table with every lens file, named relative to the scene file `source`, replaced by what it holds.

    Raises InputError for a damaged file and for a glass that is not known.
    """
    lenses = [
        lens.model_copy(update={"surfaces": read_lens((source.parent / lens.surfaces).resolve())})
        if isinstance(lens.surfaces, str)
        else lens
        for lens in camera.lens
    ]
    for lens in lenses:
        for number, surface in enumerate(() if isinstance(lens.surfaces, str) else lens.surfaces or ()):
            try:
                glass.check(surface.glass or glass.AIR)
            except InputError as error:
                raise InputError(f"{source}: camera.lens.{lens.name}.surfaces[{number}].glass: {error}") from error
    return camera.model_copy(update={"lens": tuple(lenses)})


def _from_toml(text: str, path: Path) -> tuple[Surface, ...]:
    try:
        data = toml.loads(text)
    except ValueError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    try:
        return LensFile.model_validate(data).surfaces
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error, data, LensFile)}") from error


def _from_rows(text: str, path: Path) -> tuple[Surface, ...]:
    lines = [line.partition("#")[0].split() for line in text.splitlines()]
    rows = [(number, _numbers(words, path, number)) for number, words in enumerate(lines, start=1) if words]
    if rows and len(rows[0][1]) == 1:
        del rows[0]  # the focal length, which follows from the rows
    if not rows:
        raise InputError(f"{path}: expected rows of {COLUMNS}, got none")
    surfaces: list[Surface] = []
    before = 1.0
    for number, values in rows:
        if len(values) != 4:
            raise InputError(f"{path}, line {number}: expected four numbers ({COLUMNS}), got {len(values)}")
        surfaces.append(_surface(values, before, last=number == rows[-1][0], place=f"{path}, line {number}"))
        before = values[2] or 1.0
    return tuple(surfaces)


def _numbers(words: list[str], path: Path, number: int) -> list[float]:
    values: list[float] = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            value = float("nan")
        if not abs(value) < 1e9:
            raise InputError(f"{path}, line {number}: expected numbers ({COLUMNS}), got '{shortened(word)}'")
        values.append(value)
    return values


def _surface(values: list[float], before: float, *, last: bool, place: str) -> Surface:
    radius, thickness, index, diameter = values
    if thickness < 0:
        raise InputError(f"{place}: expected a thickness of 0 mm or more, got {thickness:g}")
    if index and not 1 <= index <= 5:
        raise InputError(f"{place}: expected an index of refraction from 1 to 5, or 0 for air, got {index:g}")
    if diameter <= 0:
        raise InputError(f"{place}: expected a diameter above 0 mm, got {diameter:g}")
    listed: dict[str, Any] = {"semi_diameter": f"{diameter / 2!r} mm"}
    if radius:
        listed["radius"] = f"{radius!r} mm"
    if thickness and not last:
        listed["thickness"] = f"{thickness!r} mm"
    if index > 1:
        listed["index"] = index
    listed["stop"] = radius == 0 and (index == 0 or index == before == 1)
    try:
        return Surface.model_validate(listed)
    except ValidationError as error:
        raise InputError(f"{place}: {explain(error, listed, Surface)}") from error
