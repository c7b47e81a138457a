"""Lens files: the surfaces of a lens, from the target to the sensor.

Three formats are read. A TOML file holds the key of a scene file, `surfaces = [{radius = "1 mm", thickness = "0.5 mm",
glass = "N-BK7", semi_diameter = "0.2 mm"}, ...]`, and optionally a `title`. A file .zmx is a sequential lens of Zemax
(`.zemax`). Any other file is read as the text of PBRT's realistic camera: rows of radius, thickness,
index of refraction and diameter, in millimetres, with comments after a #; a single number in the first row is the focal
length. PBRT's radii have the sign used here, positive if the centre of curvature lies towards the film. Its index 0 is
air; its last thickness, to the film, is ignored, because the magnification determines the distance of the sensor; a
radius of 0 is a plane, and the aperture stop if there is air on both sides of it or its index is 0.

Source: M. Pharr, W. Jakob, G. Humphreys, Physically Based Rendering, section 6.4 (third edition).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.input_files import read_any_text, real_path

from ..tables import glass, toml
from ..tables.camera import MOST_SURFACES, SURFACES, CameraTable, Surface
from ..tables.messages import validated
from ..tables.table import Table
from .zemax import Catalogue, number, read_catalogue, read_zmx, surface_of

LARGEST = 10**6  # bytes
COLUMNS = "radius, thickness, index of refraction, diameter"


class LensFile(Table):
    """The content of a lens file in TOML."""

    title: str = ""
    surfaces: Annotated[tuple[Surface, ...], SURFACES, Field(min_length=1)]


def read_lens(path: Path) -> tuple[Surface, ...]:
    """Read the surfaces of a lens from a file in TOML (.toml), of Zemax (.zmx) or in PBRT's text format (any other).

    Raises InputError that names the file, the row or the key, what was expected and what came.
    """
    if path.suffix.lower() == ".zmx":
        return _with_one_stop(read_zmx(path), path)
    text = read_any_text(path, "lens file", LARGEST)
    return _with_one_stop(_from_toml(text, path) if path.suffix == ".toml" else _from_rows(text, path), path)


def _with_one_stop(surfaces: tuple[Surface, ...], path: Path) -> tuple[Surface, ...]:
    stops = sum(surface.stop for surface in surfaces)
    if stops > 1:
        raise InputError(f"{path}: expected one aperture stop at most, got {stops}; mark only the smallest")
    return surfaces


def with_surfaces(camera: CameraTable, source: Path) -> CameraTable:
    """The camera's table with every name of a lens file, relative to the scene file `source`, replaced by its surfaces.

    Glasses of the catalogue are replaced by their dispersion, so that the result needs no other file. The catalogue
    comes before the built-in glasses. Raises InputError for a damaged file and for an unknown glass.
    """
    lenses = [
        lens.model_copy(update={"surfaces": read_lens(real_path(source.parent / lens.surfaces))})
        if isinstance(lens.surfaces, str)
        else lens
        for lens in camera.lens
    ]
    catalogue = None
    if camera.glass_catalogue is not None:
        catalogue = read_catalogue(real_path(source.parent / camera.glass_catalogue))
    for place, lens in enumerate(lenses):
        if lens.surfaces and not isinstance(lens.surfaces, str):
            where = f"{source}: camera.lens.{lens.name}.surfaces"
            surfaces = tuple(
                _with_glass(surface, catalogue, f"{where}[{number}].glass")
                for number, surface in enumerate(lens.surfaces)
            )
            lenses[place] = lens.model_copy(update={"surfaces": surfaces})
    return camera.model_copy(update={"lens": tuple(lenses), "glass_catalogue": None})


def _with_glass(surface: Surface, catalogue: Catalogue | None, where: str) -> Surface:
    """The surface with the dispersion of its glass, if that is from the catalogue. Raises InputError if unknown."""
    if surface.glass is None or surface.dispersion is not None:
        return surface
    name = glass.ALIASES.get(surface.glass, surface.glass)
    if catalogue is not None:
        found = glass.spelling(surface.glass, catalogue.entries)
        if found is not None:
            return surface.model_copy(update={"glass": found, "dispersion": catalogue.dispersion(found)})
    try:
        glass.check(name)
    except InputError as error:
        nearest = catalogue and glass.nearest(surface.glass, catalogue.entries)
        advice = f"; the catalogue's nearest glass is '{shortened(nearest)}'" if nearest else ""
        raise InputError(f"{where}: {error}{advice}") from error
    return surface.model_copy(update={"glass": name})


def _from_toml(text: str, path: Path) -> tuple[Surface, ...]:
    try:
        data = toml.loads(text)
    except ValueError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    return validated(LensFile, data, str(path)).surfaces


def _from_rows(text: str, path: Path) -> tuple[Surface, ...]:
    lines = [line.partition("#")[0].split() for line in text.splitlines()]
    rows = [
        (line, [number(word, f"{path}, line {line}", COLUMNS) for word in words])
        for line, words in enumerate(lines, start=1)
        if words
    ]
    if rows and len(rows[0][1]) == 1:
        del rows[0]  # the focal length, which follows from the surfaces
    if not rows:
        raise InputError(f"{path}: expected rows of {COLUMNS}, got none")
    if len(rows) > MOST_SURFACES:
        raise InputError(f"{path}: expected at most {MOST_SURFACES} surfaces, got {len(rows)}")
    surfaces: list[Surface] = []
    before = 1.0
    for line, values in rows:
        if len(values) != 4:
            raise InputError(f"{path}, line {line}: expected four numbers ({COLUMNS}), got {len(values)}")
        surfaces.append(_surface(values, before, last=line == rows[-1][0], where=f"{path}, line {line}"))
        before = values[2] or 1.0
    return tuple(surfaces)


def _surface(values: list[float], before: float, *, last: bool, where: str) -> Surface:
    radius, thickness, index, diameter = values
    lengths = {"radius": radius, "thickness": 0.0 if last else thickness, "semi_diameter": diameter / 2}
    table: dict[str, Any] = {} if index in (0, 1) else {"index": index}
    return surface_of(lengths, table | {"stop": radius == 0 and (index == 0 or index == before == 1)}, where)
