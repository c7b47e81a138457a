"""The table below the drawing of a camera: a line per lens type."""

from __future__ import annotations

from math import atan, degrees
from typing import Any

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

from .lengths import length_words
from .sensor_drawing import airy_diameter

# Heading of each column, and where it begins, in inches
COLUMNS = (
    ("type", 0.75),
    ("magnification\non the grid", 1.2),
    ("magnification\noptical", 2.15),
    ("array", 3.1),
    ("aperture", 3.65),
    ("focal length", 4.9),
    ("lens to sensor", 5.75),
    ("sub-image", 6.7),
    ("field of view", 7.75),
    ("Airy disk", 9.0),
)


def write_key(figure: Any, camera: Camera, colours: dict[str, str], top: float, line: float) -> None:
    """Write magnifications, arrays, lenses and sub-images of all types as a table; `top` and `line` are inches."""
    width, height = figure.get_size_inches()
    style: dict[str, Any] = {"fontsize": 8, "va": "center"}
    for heading, left in COLUMNS:
        figure.text(left / width, (top + line / 2) / height, heading, fontweight="bold", linespacing=1.1, **style)
    for number, lens_type in enumerate(camera.types):
        level = (top - (number + 1) * line) / height
        for (heading, left), words in zip(COLUMNS, _cells(camera, lens_type), strict=True):
            colour = {"color": colours[lens_type.name], "fontweight": "bold"} if heading == "type" else {}
            figure.text(left / width, level, words, **style, **colour)


def _cells(camera: Camera, lens_type: LensType) -> tuple[str, ...]:
    depth, (rows, columns) = camera.depth(lens_type), lens_type.pixels
    disk = airy_diameter(camera, lens_type)
    return (
        lens_type.name,
        str(1 / lens_type.ratio),
        f"1/{camera.distance / depth:.4g}",
        f"{lens_type.array[0]} x {lens_type.array[1]}",
        aperture_words(camera, lens_type),
        length_words(camera.focal_length(lens_type)),
        length_words(depth),
        f"{rows} x {columns} pixels",
        " x ".join(f"{degrees(2 * atan(count * camera.pixel_pitch / 2 / depth)):.3g}°" for count in (rows, columns)),
        "not modelled" if disk is None else f"{disk / camera.pixel_pitch:.2g} pixels",
    )


def aperture_words(camera: Camera, lens_type: LensType) -> str:
    """Return the diameter and the f-number of a lens, or what it is instead."""
    optics = lens_type.optics
    if optics.aperture is not None:
        return f"{length_words(optics.aperture)}, f/{camera.focal_length(lens_type) / optics.aperture:.2g}"
    return "pinholes" if optics.surfaces is None else f"{len(optics.surfaces)} surfaces"
