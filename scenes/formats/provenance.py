"""The record of how a stack or a model was made, checked when it is read."""

from __future__ import annotations

import json
from typing import Any, cast

TYPES: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("method", "fingerprint", "truth", "variant", "sampler"), str),
    **dict.fromkeys(("versions", "agreement", "fit"), dict),
    **dict.fromkeys(("seed", "first_seed", "samples", "fewest_samples", "passes"), int),
    "seconds": (int, float),
}


def checked(record: object) -> dict[str, Any]:
    """Return the record if its known keys have the right types.

    Raises ValueError for a wrong type, and for numbers that JSON does not have.
    """
    if not isinstance(record, dict):
        raise ValueError("expected a record of how it was made, a table, got something else")
    checked_record = cast(dict[str, Any], record)
    for key, types in TYPES.items():
        value = checked_record.get(key)
        if key in checked_record and (not isinstance(value, types) or isinstance(value, bool)):
            raise ValueError(f"its record has a {key} of another type than expected")
    json.dumps(checked_record, allow_nan=False)
    return checked_record
