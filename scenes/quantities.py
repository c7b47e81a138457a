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


def _length(value: object) -> float:
    if isinstance(value, float | int) and not isinstance(value, bool):
        raise ValueError(f'expected a length with its unit, such as "{value} mm", got the bare number {value}')
    if not isinstance(value, str):
        raise ValueError(f'expected a length with its unit, such as "1 mm", got {value!r}')
    try:
        length = float(_units().Quantity(value).to("mm").magnitude)
    except Exception as error:  # pint raises a dozen kinds, tokenize's among them
        raise ValueError(f'expected a length with its unit, such as "6 um" or "1 m", got {value!r}') from error
    if not 0 < length < float("inf"):
        raise ValueError(f"expected a length above zero, got {value!r}")
    return length


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
