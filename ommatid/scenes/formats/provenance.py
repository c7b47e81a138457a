"""The record of how a stack or a model was made, checked when it is read."""

from __future__ import annotations

import json
from typing import Annotated, Any, cast

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictBool, TypeAdapter, ValidationError

from ommatid.runtime.errors import shortened_repr

Text = Annotated[str, Field(max_length=1000)]
Count = Annotated[int, Field(ge=0, lt=2**64)]
STRICT = ConfigDict(strict=True, allow_inf_nan=False)


class _Agreement(BaseModel):
    """The comparison of H with the ideal one."""

    model_config = {**STRICT, "extra": "forbid"}

    rms_difference_from_ideal: float | None
    max_z: float | None
    p_value: float | None


class _Fit(BaseModel):
    """The record of a fit: the keys that are printed must have the right types, the others any."""

    model_config = STRICT

    accepted: Count
    refused: list[Text]


def _check_fit(table: dict[str, Any]) -> dict[str, Any]:
    _Fit.model_validate(table)
    return table


FitRecord = Annotated[dict[str, Any], AfterValidator(_check_fit)]
CHECKS: dict[str, tuple[str, Any]] = {
    **dict.fromkeys(("method", "fingerprint", "truth", "variant", "sampler"), ("a text", Text)),
    **dict.fromkeys(("versions", "not_reached"), ("a table of texts", dict[str, Text])),
    **dict.fromkeys(
        ("seed", "first_seed", "samples", "fewest_samples", "passes", "rays"), ("a whole number of 0 or more", Count)
    ),
    "reached": ("true or false", StrictBool),
    "auto": ("a table", dict[str, Any]),
    "agreement": ("a table of numbers", Annotated[dict[str, Any], AfterValidator(_Agreement.model_validate)]),
    "fit": ("a table with accepted and refused", FitRecord),
    "seconds": ("a time of 0 or more", Annotated[float, Field(ge=0, le=1e15)]),
}


def checked(record: object) -> dict[str, Any]:
    """Return the record if its known keys have the right types and values that can be.

    Raises ValueError for others, and for numbers that JSON does not have.
    """
    if not isinstance(record, dict):
        raise ValueError("expected a record of how it was made, a table, got something else")
    known = cast(dict[str, Any], record)
    for key, (expected, kind) in CHECKS.items():
        try:
            if key in known:
                TypeAdapter[Any](kind, config=STRICT).validate_python(known[key])
        except ValidationError as error:
            raise ValueError(f"its record should have {expected} as {key}, got {shortened_repr(known[key])}") from error
    json.dumps(known, allow_nan=False)
    return known
