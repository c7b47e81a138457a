"""Quantities of optics in the scene file: fields of view, f-numbers, and the size of a sensor.

Formats of sensors are named after television tubes of that diameter, whose picture was about two thirds as wide. They
are not standardised: sensors of one name differ by some percent, so the size of a real one is that of its data sheet.
"""

from __future__ import annotations

from math import pi
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema

from ommatid.runtime.errors import shortened_repr

from ..tables.table import at_most
from ..tables.units import Angle, Length, pair

# Height and width in mm. To 2/3: typical sizes of digital cameras (Digital Photography Review, "Sensor sizes", 2002,
# and data sheets for 1/2.5, 1/2.3 and 1/1.7); 1, 4/3: of cameras of Nikon (CX) and of the Four Thirds standard; APS-C:
# of Nikon (DX) and Sony, to 0.1 mm (Canon's is 14.9 x 22.3 mm); full frame: that of 35 mm film.
FORMATS = {
    "1/4": ("2.4 mm", "3.2 mm"),
    "1/3.2": ("3.42 mm", "4.54 mm"),
    "1/3": ("3.6 mm", "4.8 mm"),
    "1/2.7": ("3.96 mm", "5.27 mm"),
    "1/2.5": ("4.29 mm", "5.76 mm"),
    "1/2.3": ("4.55 mm", "6.17 mm"),
    "1/2": ("4.8 mm", "6.4 mm"),
    "1/1.8": ("5.32 mm", "7.18 mm"),
    "1/1.7": ("5.7 mm", "7.6 mm"),
    "2/3": ("6.6 mm", "8.8 mm"),
    "1": ("8.8 mm", "13.2 mm"),
    "4/3": ("13 mm", "17.3 mm"),
    "APS-C": ("15.6 mm", "23.5 mm"),
    "full frame": ("24 mm", "36 mm"),
}


def _below_half_turn(angle: float) -> float:
    if angle >= pi:
        raise ValueError("expected a field of view below 180 deg")
    return angle


def _one_or_two(value: object) -> object:
    return (value,) if isinstance(value, str) else pair(value)


def _size(value: object) -> object:
    """Replace the name of a format by its height and width. Raises ValueError for an unknown one."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)  # --set reads the format "1" as 1
    text = f"{value:g}" if is_number else value
    if not isinstance(text, str):
        return pair(value)
    name = text.removesuffix('"').removesuffix(" inch").casefold()
    named = {known.casefold(): size for known, size in FORMATS.items()}
    if name in named:
        return named[name]
    raise ValueError(
        f"expected one of the formats {', '.join(FORMATS)}, or height and width, such as"
        f' ["4.55 mm", "6.17 mm"], got {shortened_repr(value)[:50]}; take one of these'
    )


FNumber = Annotated[float, Field(gt=0, le=1e6)]
FieldOfView = Annotated[
    tuple[Annotated[Angle, AfterValidator(_below_half_turn)], ...],
    at_most(2, "angles"),
    BeforeValidator(_one_or_two),
    Field(min_length=1, max_length=2),
    WithJsonSchema(
        {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": 2}]}
    ),
]
SensorSize = Annotated[
    tuple[Length, Length],
    BeforeValidator(_size),
    WithJsonSchema(
        {
            "anyOf": [
                {"enum": list(FORMATS)},
                {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2},
            ]
        }
    ),
]
