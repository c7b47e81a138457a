"""The table below the drawing of a camera: a line per lens type."""

from __future__ import annotations

from typing import Any

from ommatid.scenes.camera import Camera
from ommatid.scenes.geometry.optical_terms import LensTerms, OpticalTerms
from ommatid.scenes.lens_type import LensType

from .lengths import length_words

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


def write_key(
    figure: Any, camera: Camera, terms: OpticalTerms, colours: dict[str, str], top: float, line: float
) -> None:
    """Write magnifications, arrays, lenses and sub-images of all types as a table; `top` and `line` are inches."""
    width, height = figure.get_size_inches()
    style: dict[str, Any] = {"fontsize": 8, "va": "center"}
    for heading, left in COLUMNS:
        figure.text(left / width, (top + line / 2) / height, heading, fontweight="bold", linespacing=1.1, **style)
    for number, (lens_type, lens_terms) in enumerate(zip(camera.types, terms.types, strict=True)):
        level = (top - (number + 1) * line) / height
        for (heading, left), words in zip(COLUMNS, _cells(camera, lens_type, lens_terms), strict=True):
            colour = {"color": colours[lens_type.name], "fontweight": "bold"} if heading == "type" else {}
            figure.text(left / width, level, words, **style, **colour)


def _cells(camera: Camera, lens_type: LensType, terms: LensTerms) -> tuple[str, ...]:
    rows, columns = lens_type.pixels
    return (
        lens_type.name,
        str(terms.grid_magnification),
        f"1/{1 / terms.magnification:.4g}",
        f"{lens_type.array[0]} x {lens_type.array[1]}",
        _aperture_words(lens_type, terms),
        length_words(terms.focal_length),
        length_words(terms.total_track),
        f"{rows} x {columns} pixels",
        " x ".join(f"{angle:.3g}°" for angle in terms.field_of_view),
        _airy_words(camera, terms),
    )


def _aperture_words(lens_type: LensType, terms: LensTerms) -> str:
    """Return the diameter and the f-number of a lens, or what it is instead."""
    if terms.aperture is not None and terms.f_number is not None:
        return f"{length_words(terms.aperture)}, f/{terms.f_number:.2g}"
    surfaces = lens_type.optics.surfaces
    return "pinholes" if surfaces is None else f"{len(surfaces)} surfaces"


def _airy_words(camera: Camera, terms: LensTerms) -> str:
    if terms.airy_diameter is None:
        return "none"
    return f"{terms.airy_diameter:.2g} pixels" + ("" if camera.wavelength else ", left out")
