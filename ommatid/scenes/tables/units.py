"""Quantities of the scene file - lengths, ratios, counts, pairs - checked and converted when they are read.

Lengths become millimetres here and nowhere else.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import isfinite
from typing import Annotated, Any, Literal, cast

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, WithJsonSchema
from pydantic_core import CoreSchema, core_schema

from ommatid.runtime.errors import shortened_repr

LONGEST = 80  # characters of a quantity, which keeps the time to parse it short
NUMBER = r"[-+]?(\d[\d_]*\.?\d*|\.\d+)([eE][-+]?\d{1,3})?"
UNIT = r"(?:[^\W\d]+|°)((\*\*|\^)-?\d|[²³])?"
COMMON = re.compile(rf"\s*({NUMBER})\s*(\w+)\s*")
QUANTITY = re.compile(rf"\s*{NUMBER}(\s*/\s*{NUMBER})?\s*\*?\s*{UNIT}(\s*[*/]\s*{UNIT})*\s*")
RATIO = re.compile(rf"\s*{NUMBER}(/\d+)?\s*")
EXTREME = 1e15  # largest quantity in mm, s, rad or lux, and inverse of the smallest: squares and ratios stay finite
FEW = 100  # bare number from which a length may be meant in nm
FACTORS = {  # of the commonest units, to the last bit as pint has them; pint takes half a second to load
    ("mm", "mm"): 1.0,
    ("um", "mm"): 0.001,
    ("nm", "mm"): 1.0000000000000002e-06,
    ("cm", "mm"): 10.0,
    ("m", "mm"): 1000.0,
    ("s", "s"): 1.0,
    ("ms", "s"): 0.001,
    ("deg", "rad"): 0.017453292519943295,
    ("rad", "rad"): 1.0,
    ("lux", "lux"): 1.0,
}
LONGEST_NAME, LONGEST_PATH = 255, 4000  # bytes that file systems accept
NOT_ROUNDED = Fraction(1, 40)  # magnification above which a decimal number may be a rounded 1/m
FINEST_PART = 20  # of the side of a sensor pixel: exact areas of rotated pixels divide it
AUTO: Literal["auto"] = "auto"  # samples: as many as needed


@cache
def _units() -> Any:
    import pint

    return cast(Any, pint).UnitRegistry()


def _quantity(text: str, unit: str) -> float:
    """Convert a text of a number and its unit to another unit. Raises one of pint's many exceptions.

    Pint evaluates expressions, and 9**9**9 would take weeks; so only a number with units is passed on.
    """
    if len(text) > LONGEST or QUANTITY.fullmatch(text) is None:
        raise ValueError("neither a number nor a unit")
    common = COMMON.fullmatch(text)
    if common is not None and (factor := FACTORS.get((common[4], unit))) is not None:
        return float(common[1]) * factor
    return float(_units().Quantity(text).to(unit).magnitude)


@dataclass(frozen=True)
class Quantity:
    """A number with its unit, which is read from texts such as "6 um" and written with `unit`.

    what, description : in messages and in the schema of scene files;  examples : of texts that are read
    """

    unit: str
    what: str
    examples: tuple[str, str]
    description: str
    signed: bool = False

    def read(self, value: object) -> float:
        """Convert a text to a number of `unit`. Raises ValueError that says what was expected."""
        what, (first, second), got = self.what, self.examples, shortened_repr(value)
        if isinstance(value, float | int) and not isinstance(value, bool):
            units = ["nm" if self.unit == "mm" and value >= FEW else second.split()[1], first.split()[1]]
            examples = " or ".join(f'"{value} {unit}"' for unit in units)
            raise ValueError(f"expected {what} with its unit, such as {examples}, got the bare number {value}")
        if not isinstance(value, str):
            raise ValueError(f'expected {what} with its unit, such as "{first}", got {got}')
        try:
            number = _quantity(value, self.unit)
        except Exception as error:  # pint raises a dozen types, tokenize's among them
            raise ValueError(f'expected {what} with its unit, such as "{second}" or "{first}", got {got}') from error
        if number == 0 or not isfinite(number) or (number < 0 and not self.signed):
            raise ValueError(f"expected {what} {'other than' if self.signed else 'above'} zero, got {got}")
        if not 1 / EXTREME <= abs(number) <= EXTREME:
            raise ValueError(f"expected {what} between {1 / EXTREME:g} and {EXTREME:g} {self.unit}, got {got}")
        return number

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], CoreSchema]) -> CoreSchema:
        """Read and write the quantities of a scene file."""
        written = core_schema.plain_serializer_function_ser_schema(lambda value: f"{value!r} {self.unit}")
        return core_schema.no_info_before_validator_function(self.read, handler(source), serialization=written)

    def __get_pydantic_json_schema__(self, *_: object) -> dict[str, Any]:
        """Describe the texts of a scene file."""
        return {"type": "string", "description": self.description}


def in_unit(text: str, unit: str) -> float:
    """Convert a text such as "1 um" to a number of another unit. Raises ValueError if it is no such quantity."""
    base, factor = next(((base, factor) for (name, base), factor in FACTORS.items() if name == unit), (unit, 1.0))
    try:
        return _quantity(text, base) / factor
    except Exception as error:  # pint raises a dozen types
        raise ValueError(f"expected a quantity in {unit}, got {shortened_repr(text)}") from error


def _ratio(value: object) -> Fraction:
    try:
        if isinstance(value, bool) or not isinstance(value, str | int | float | Fraction):
            raise ValueError
        text = str(value)
        if len(text) > LONGEST or RATIO.fullmatch(text) is None:  # 1e-9999999999 would be a huge denominator
            raise ValueError
        ratio = Fraction(text)
    except (ValueError, ZeroDivisionError) as error:
        raise ValueError(f'expected a ratio such as "1/3" or 0.25, got {shortened_repr(value)}') from error
    if ratio.denominator > 10**6 or ratio.numerator > 10**6:
        raise ValueError(f"expected a ratio of numbers up to a million, got {shortened_repr(value)}")
    return ratio


def magnification(value: object) -> Fraction:
    """Read a magnification on the pixel grid. Raises ValueError."""
    ratio = _ratio(value)
    if not 0 < ratio <= 1:
        raise ValueError(f'expected a magnification above 0 and at most 1, such as "1/3", got {shortened_repr(value)}')
    meant, digits = Fraction(1, round(1 / ratio)), len(str(value).partition(".")[2])
    if (
        "/" not in str(value)
        and digits > 1
        and ratio != meant
        and ratio == round(meant, digits)
        and ratio > NOT_ROUNDED
    ):
        raise ValueError(
            f'expected an exact ratio, got {shortened_repr(value)}: write "{meant}" if that is meant, or "{ratio}"'
        )
    return ratio


def _fill_factor(value: object) -> tuple[Fraction, Fraction]:
    sides = cast(object, value) if isinstance(value, list | tuple) else (value, value)
    expected = (
        f'expected a fill factor above 0 and at most 1 with a denominator of {FINEST_PART} or less, such as "2/3", or'
        ' two, down and across, such as ["2/3", 1]'
    )
    ratios = _two_ratios(sides, expected)
    if not all(0 < ratio <= 1 and ratio.denominator <= FINEST_PART for ratio in ratios):
        raise ValueError(f"{expected}, got {shortened_repr(cast(object, value))}")
    return ratios


def _two_ratios(value: object, expected: str) -> tuple[Fraction, Fraction]:
    """Read a pair of ratios of 0 or more. Raises ValueError that begins with `expected`."""
    ratios = [_ratio(each) for each in cast(Sequence[object], value)] if isinstance(value, list | tuple) else []
    if len(ratios) != 2 or min(ratios) < 0:
        raise ValueError(f"{expected}, got {shortened_repr(cast(object, value))}")
    return ratios[0], ratios[1]


def _step(value: object) -> tuple[Fraction, Fraction]:
    steps = cast(object, value) if isinstance(value, list | tuple) else (value, value)
    return _two_ratios(steps, "expected a step of 0 or more pixels of the target, or two such as [2, 1]")


def _window(value: object) -> tuple[Fraction, Fraction]:
    return _two_ratios(value, 'expected a row and a column of the target of 0 or more, such as [12, "7/2"]')


def pair(value: object) -> object:
    """Convert a list of TOML to the tuple that frozen tables hold; return anything else unchanged."""
    return tuple(value) if isinstance(value, list) else value  # type: ignore[arg-type]


def counts(value: object, also: str = "") -> object:
    """Read [rows, columns]; also : words on what else would do. Raises ValueError that says what was expected."""
    return _whole_pair(value, 1, f"[rows, columns], two whole numbers of at least 1, such as [19, 19]{also}")


def _corner(value: object) -> object:
    return _whole_pair(value, 0, "[row, column], two whole numbers of at least 0, such as [12, 8]")


def _whole_pair(value: object, least: int, expected: str) -> object:
    numbers = list(cast(Sequence[object], value)) if isinstance(value, list | tuple) else None
    if numbers is None or len(numbers) != 2 or not all(type(each) is int and each >= least for each in numbers):
        raise ValueError(
            f"expected {expected}, got {shortened_repr(cast(object, value) if numbers is None else numbers)}"
        )
    return tuple(numbers)


def _plain_ratios(ratios: tuple[Fraction, ...]) -> list[str | int]:
    return [_plain_ratio(ratio) for ratio in ratios]


def _plain_step(step: tuple[Fraction, Fraction]) -> str | int | list[str | int]:
    return _plain_ratio(step[0]) if step[0] == step[1] else _plain_ratios(step)


def _plain_ratio(ratio: Fraction) -> str | int:
    return int(ratio) if ratio.denominator == 1 else str(ratio)


def file_name(value: str) -> str:
    """Return the name if a file can have it. Raises ValueError that says what was expected."""
    if "\0" in value or not value.strip():
        raise ValueError(f"expected the name of a file, got {shortened_repr(value)}")
    name = os.fsencode(value)
    if len(name) > LONGEST_PATH or max(map(len, name.split(b"/"))) > LONGEST_NAME:
        raise ValueError(f"expected the name of a file, got one of {len(name)} bytes, {shortened_repr(value)}")
    return value


_RATIO = WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "number"}], "description": 'a ratio, such as "1/3"'})
_STEP = WithJsonSchema(
    {
        "anyOf": [
            {"type": "string"},
            {"type": "number"},
            {"type": "array", "items": {"type": ["string", "number"]}, "minItems": 2, "maxItems": 2},
        ],
        "description": "a ratio, or two, down and across",
    }
)

LENGTH = Quantity("mm", "a length", ("1 mm", "6 um"), 'a length with its unit, such as "6 um"')
DURATION = Quantity("s", "a time", ("30 s", "2 min"), 'a time with its unit, such as "30 s"')
SIGNED_ANGLE = Quantity(
    "rad", "an angle", ("1 deg", "-2 mrad"), 'an angle with its unit and its sign, such as "-1 deg"', signed=True
)
_CURVATURE = "a radius of curvature", ("1 mm", "-800 um"), 'a length with its unit and its sign, such as "-0.8 mm"'

Length = Annotated[float, LENGTH]
Radius = Annotated[float, Quantity("mm", *_CURVATURE, signed=True)]
Time = Annotated[float, Quantity("s", "a time", ("10 ms", "0.5 s"), 'a time with its unit, such as "10 ms"')]
Angle = Annotated[float, Quantity("rad", "an angle", ("1 deg", "2 mrad"), 'an angle with its unit, such as "0.1 deg"')]
SignedAngle = Annotated[float, SIGNED_ANGLE]
Illuminance = Annotated[
    float, Quantity("lux", "an illuminance", ("500 lux", "1 klux"), 'an illuminance, such as "500 lux"')
]
Magnification = Annotated[Fraction, BeforeValidator(magnification), PlainSerializer(_plain_ratio), _RATIO]
FillFactor = Annotated[tuple[Fraction, Fraction], BeforeValidator(_fill_factor), PlainSerializer(_plain_step), _STEP]
Step = Annotated[tuple[Fraction, Fraction], BeforeValidator(_step), PlainSerializer(_plain_step), _STEP]
Window = Annotated[
    tuple[Fraction, Fraction],
    BeforeValidator(_window),
    PlainSerializer(_plain_ratios),
    WithJsonSchema({"type": "array", "items": {"type": ["string", "number"]}, "minItems": 2, "maxItems": 2}),
]
Count = Annotated[int, Field(ge=1)]
Pair = Annotated[tuple[Count, Count], BeforeValidator(counts)]
Corner = Annotated[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], BeforeValidator(_corner)]
FileName = Annotated[str, AfterValidator(file_name)]
Samples = Annotated[int, Field(ge=16, le=2**24)] | Literal["auto"]
Memory = Annotated[float, Quantity("byte", "an amount of memory", ("4 GB", "500 MB"), 'an amount, such as "4 GB"')]
