"""The record of how a stack or a model was made, checked when it is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import isfinite
from typing import Annotated, Any, cast

from pydantic import AfterValidator

from ommatid.runtime.errors import shortened_repr

LONGEST_TEXT = 1000  # characters
LARGEST = 2**64  # of whole numbers
LONGEST_TIME = 1e15  # seconds


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST_TEXT


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < LARGEST


def _is_time(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= LONGEST_TIME


def _is_table_of(values: Callable[[object], bool]) -> Callable[[object], bool]:
    def check(table: object) -> bool:
        return isinstance(table, dict) and all(map(values, cast(dict[str, object], table).values()))

    return check


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, float) and isfinite(value))


def _is_agreement(table: object) -> bool:
    keys = {"rms_difference_from_ideal", "max_z", "p_value"}
    return _is_table_of(_is_number)(table) and cast(dict[str, object], table).keys() == keys


def _is_fit(table: object) -> bool:
    """True for the record of a fit: the keys that are printed must have the right types, the others any."""
    if not isinstance(table, dict):
        return False
    fit = cast(dict[str, object], table)
    refused = fit.get("refused")
    names = cast(list[object], refused) if isinstance(refused, list) else [None]
    return _is_count(fit.get("accepted")) and all(map(_is_text, names))


def _check_fit(table: dict[str, Any]) -> dict[str, Any]:
    if not _is_fit(table):
        raise ValueError("expected a table with accepted and refused")
    return table


FitRecord = Annotated[dict[str, Any], AfterValidator(_check_fit)]
CHECKS: dict[str, tuple[str, Callable[[object], bool]]] = {
    **dict.fromkeys(("method", "fingerprint", "truth", "variant", "sampler"), ("a text", _is_text)),
    **dict.fromkeys(("versions", "not_reached"), ("a table of texts", _is_table_of(_is_text))),
    **dict.fromkeys(
        ("seed", "first_seed", "samples", "fewest_samples", "passes", "rays"),
        ("a whole number of 0 or more", _is_count),
    ),
    "reached": ("true or false", lambda value: isinstance(value, bool)),
    "auto": ("a table", lambda value: isinstance(value, dict)),
    "agreement": ("a table of numbers", _is_agreement),
    "fit": ("a table with accepted and refused", _is_fit),
    "seconds": ("a time of 0 or more", _is_time),
}


def checked(record: object) -> dict[str, Any]:
    """Return the record if its known keys have the right types and values that can be.

    Raises ValueError for others, and for numbers that JSON does not have.
    """
    if not isinstance(record, dict):
        raise ValueError("expected a record of how it was made, a table, got something else")
    checked_record = cast(dict[str, Any], record)
    for key, (expected, is_right) in CHECKS.items():
        if key in checked_record and not is_right(checked_record[key]):
            raise ValueError(f"its record should have {expected} as {key}, got {shortened_repr(checked_record[key])}")
    json.dumps(checked_record, allow_nan=False)
    return checked_record
