"""Quantities of the scene file - lengths, ratios, counts, pairs - checked and converted where they are read.

Lengths become millimetres here and nowhere else.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from typing import Annotated, Any, cast

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema


@cache
def _units() -> Any:
    import pint

    return cast(Any, pint).UnitRegistry()


def _in_units(value: object, unit: str, what: str, examples: tuple[str, str], *, signed: bool = False) -> float:
    """A text such as "6 um" as a number of `unit`. Raises ValueError that says what was expected."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        example = f"{value} {examples[0].split()[1]}"
        raise ValueError(f'expected {what} with its unit, such as "{example}", got the bare number {value}')
    if not isinstance(value, str):
        raise ValueError(f'expected {what} with its unit, such as "{examples[0]}", got {value!r}')
    try:
        number = float(_units().Quantity(value).to(unit).magnitude)
    except Exception as error:  # pint raises a dozen kinds, tokenize's among them
        raise ValueError(
            f'expected {what} with its unit, such as "{examples[1]}" or "{examples[0]}", got {value!r}'
        ) from error
    if not (number != 0 and abs(number) < float("inf")) or (number < 0 and not signed):
        raise ValueError(f"expected {what} {'other than' if signed else 'above'} zero, got {value!r}")
    return number


def _length(value: object) -> float:
    return _in_units(value, "mm", "a length", ("1 mm", "6 um"))


def _radius(value: object) -> float:
    return _in_units(value, "mm", "a radius of curvature", ("1 mm", "-800 um"), signed=True)


def _time(value: object) -> float:
    return _in_units(value, "s", "a time", ("10 ms", "0.5 s"))


def _angle(value: object) -> float:
    return _in_units(value, "rad", "an angle", ("1 deg", "2 mrad"))


def _illuminance(value: object) -> float:
    return _in_units(value, "lux", "an illuminance", ("500 lux", "1 klux"))


def _ratio(value: object) -> Fraction:
    try:
        if isinstance(value, bool) or not isinstance(value, str | int | float | Fraction):
            raise ValueError
        ratio = Fraction(str(value))
    except (ValueError, ZeroDivisionError) as error:
        raise ValueError(f'expected a ratio such as "1/3" or 0.25, got {value!r}') from error
    if ratio.denominator > 10**6 or ratio.numerator > 10**6:
        raise ValueError(f"expected a ratio of numbers up to a million, got {value!r}")
    return ratio


def _magnification(value: object) -> Fraction:
    ratio = _ratio(value)
    if not 0 < ratio <= 1:
        raise ValueError(f'expected a magnification above 0 and at most 1, such as "1/3", got {value!r}')
    return ratio


def _step(value: object) -> Fraction:
    ratio = _ratio(value)
    if ratio < 0:
        raise ValueError(f"expected a step of 0 or more pixels of the target, got {value!r}")
    return ratio


def pair(value: object) -> object:
    """A list of TOML as the tuple that frozen tables hold; anything else as it is."""
    return tuple(value) if isinstance(value, list) else value  # type: ignore[arg-type]


def _text_of(ratio: Fraction) -> str | int:
    return int(ratio) if ratio.denominator == 1 else str(ratio)


Length = Annotated[
    float,
    BeforeValidator(_length),
    PlainSerializer(lambda value: f"{value!r} mm"),
    WithJsonSchema({"type": "string", "description": 'a length with its unit, such as "6 um"'}),
]
Radius = Annotated[
    float,
    BeforeValidator(_radius),
    PlainSerializer(lambda value: f"{value!r} mm"),
    WithJsonSchema({"type": "string", "description": 'a length with its unit and its sign, such as "-0.8 mm"'}),
]
Time = Annotated[
    float,
    BeforeValidator(_time),
    PlainSerializer(lambda value: f"{value!r} s"),
    WithJsonSchema({"type": "string", "description": 'a time with its unit, such as "10 ms"'}),
]
Angle = Annotated[
    float,
    BeforeValidator(_angle),
    PlainSerializer(lambda value: f"{value!r} rad"),
    WithJsonSchema({"type": "string", "description": 'an angle with its unit, such as "0.1 deg"'}),
]
Illuminance = Annotated[
    float,
    BeforeValidator(_illuminance),
    PlainSerializer(lambda value: f"{value!r} lux"),
    WithJsonSchema({"type": "string", "description": 'an illuminance, such as "500 lux"'}),
]
_RATIO = WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "number"}], "description": 'a ratio, such as "1/3"'})
Magnification = Annotated[Fraction, BeforeValidator(_magnification), PlainSerializer(_text_of), _RATIO]
Step = Annotated[Fraction, BeforeValidator(_step), PlainSerializer(_text_of), _RATIO]
Count = Annotated[int, Field(ge=1)]
Pair = Annotated[tuple[Count, Count], BeforeValidator(pair)]
Corner = Annotated[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], BeforeValidator(pair)]
Samples = Annotated[int, Field(ge=16, le=2**24, description="per sensor pixel; rendered in 16 passes or more")]


def _memory(value: object) -> int:
    if isinstance(value, str):
        try:
            size = int(_units().Quantity(value).to("byte").magnitude)
        except Exception as error:  # as for lengths
            raise ValueError(f'expected an amount of memory such as "4 GB", got {value!r}') from error
        if 0 < size < 2**63:
            return size
    raise ValueError(f'expected an amount of memory with its unit, such as "4 GB", got {value!r}')


Memory = Annotated[
    int,
    BeforeValidator(_memory),
    PlainSerializer(lambda size: f"{size} B", return_type=str),
    WithJsonSchema({"type": "string", "examples": ["4 GB"]}),
]


def _expected_noise(value: object) -> object:
    if value == "fit" or (isinstance(value, float | int) and not isinstance(value, bool) and 0 <= value <= 1e24):
        return value if value == "fit" else float(cast(float, value))
    raise ValueError(f'expected a variance from 0 to 1e24, or "fit", got {value!r}')


ExpectedNoise = Annotated[
    float | str,
    BeforeValidator(_expected_noise),
    WithJsonSchema({"anyOf": [{"type": "number", "minimum": 0}, {"const": "fit"}]}),
]
