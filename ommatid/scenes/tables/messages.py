"""Error messages for the scene file: the key, what was expected, what came, and the nearest known key."""

from __future__ import annotations

import difflib
import re
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ommatid.runtime.errors import shortened_repr
from ommatid.runtime.printable import printable

LONGEST = 100  # characters of a key that is compared with the known ones
_SHOULD_HAVE = re.compile(r"^\w+ should have")  # of pydantic
DERIVED = {  # keys that may follow from others
    "magnification": ", or focal_length with target.distance and both pixel pitches",
    "pixels": ', or "fit", or field_of_view',
    **dict.fromkeys(("pixel_pitch", "distance"), ", or magnification and focal_length of a lens type with the others"),
}


def explain(error: ValidationError, data: dict[str, Any], model: type[BaseModel]) -> str:
    """Describe the first error in `data` in one sentence, without the file's name."""
    problems = error.errors()
    # A misspelt key is also reported as a missing one, as is a key that follows from a wrong value: prefer these two.
    unknown = [problem for problem in problems if problem["type"] == "extra_forbidden"]
    present = [problem for problem in problems if problem["type"] != "missing"]
    chosen = unknown or present or problems
    sentence = _sentence(chosen[0], data, model)
    others = len(chosen) - 1
    return sentence + (f" (and {others} more to correct)" if others else "")


def known_keys(model: type[BaseModel], prefix: str = "") -> list[str]:
    """Return all keys of the scene file in dotted form, those of lens types without the type's name."""
    keys: list[str] = []
    for name, field in model.model_fields.items():
        keys.append(prefix + name)
        for inner in _models_in(field.annotation):
            keys.extend(known_keys(inner, f"{prefix}{name}."))
    return keys


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


def _sentence(problem: ErrorDetails, data: dict[str, Any], model: type[BaseModel]) -> str:
    error_type = problem["type"]
    location = problem["loc"] if error_type == "extra_forbidden" else _keys_only(problem["loc"])
    key = printable(_dotted(location, data), LONGEST)
    if error_type == "extra_forbidden":
        keys = known_keys(model)
        bare = ".".join(part for part in location if isinstance(part, str))[-LONGEST:]
        near = difflib.get_close_matches(bare, keys, n=1, cutoff=0.5)
        last = bare.rsplit(".", 1)[-1]
        elsewhere = [known for known in keys if known.rsplit(".", 1)[-1] == last]
        nearest = (elsewhere or near or difflib.get_close_matches(bare, keys, n=1, cutoff=0.0))[0]
        return f"unknown key '{key}'; the nearest known key is '{nearest}'"
    if error_type == "missing":
        from_others = DERIVED.get(key.rsplit(".", 1)[-1], "")
        return f"the key '{key}' is missing and has no default; add it{from_others}"
    message = problem["msg"].removeprefix("Value error, ")
    message = message.replace("Input should be", "expected").replace(
        "String should match", "expected text that matches"
    )
    message = _SHOULD_HAVE.sub("expected", message).replace(" after validation", "")
    if "got" not in message:
        message = f"{message}, got {shortened_repr(problem['input'])}"
    return f"{key}: {message}" if key else message


def _keys_only(location: tuple[int | str, ...]) -> tuple[int | str, ...]:
    # pydantic appends the branch of a union or the type of a tuple, which are not keys of the file.
    return tuple(
        part for part in location if isinstance(part, int) or part.isidentifier() or ("-" in part and "[" not in part)
    )


def _dotted(location: tuple[int | str, ...], data: Any) -> str:
    parts: list[str] = []
    for part in location:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            data = None
        parts.append(_item_name(data, part) if isinstance(part, int) else part)
    return ".".join(parts)


def _item_name(table: Any, index: int) -> str:
    try:
        return str(table["name"])
    except (KeyError, TypeError):
        return str(index)
