"""What a stack or a model says of how it was made, as its readers rely on it."""

from __future__ import annotations

import json
from typing import Any, cast

KINDS: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("method", "fingerprint", "truth", "variant", "sampler"), str),
    **dict.fromkeys(("versions", "agreement", "fit"), dict),
    **dict.fromkeys(("seed", "first_seed", "samples", "fewest_samples", "passes"), int),
    "seconds": (int, float),
}


def checked(record: object) -> dict[str, Any]:
    """The record, if it is one. Raises ValueError for what is none, and for numbers that JSON does not know."""
    if not isinstance(record, dict):
        raise ValueError("expected a record of how it was made, got something else")
    told = cast(dict[str, Any], record)
    for key, kind in KINDS.items():
        if key in told and (not isinstance(told[key], kind) or isinstance(told[key], bool)):
            raise ValueError(f"its record says {key} in another way than expected")
    json.dumps(told, allow_nan=False)
    return told
