"""Error messages for the scene file: the key, what was expected, what came, and the nearest known key."""

from __future__ import annotations

import difflib
import re
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ommatid.runtime.errors import InputError, named, shortened_repr
from ommatid.runtime.printable import printable

Model = TypeVar("Model", bound=BaseModel)
LONGEST = 100  # characters of a key that is compared with the known ones
SHORTEST = 3  # characters of the beginning of a key
# What was expected, by pydantic's type of a problem; names in braces are those of its context.
EXPECTED = {
    "tuple_type": "a list in brackets, such as [1, 2]",
    "list_type": "a list in brackets, such as [1, 2]",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a text in quotation marks",
    "finite_number": "a finite number",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than": "a number below {lt:g}",
    "less_than_equal": "a number of at most {le:g}",
    "too_long": "at most {max_length} values",
    "too_short": "at least {min_length} values",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "text that matches '{pattern}'",
}
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")
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
    keys = known_keys(model)
    of_key: dict[tuple[int | str, ...], list[ErrorDetails]] = {}  # a union reports each of its branches
    for problem in chosen:
        of_key.setdefault(problem["loc"] if unknown else _key_of(problem["loc"], keys), []).append(problem)
    location, branches = next(iter(of_key.items()))
    ours = [branch for branch in branches if branch["type"] == "value_error"]
    sentence = _sentence(location, ours or branches, data, keys)
    others = len(of_key) - 1
    return sentence + (f" (and {others} more to correct)" if others else "")


def validated(model: type[Model], data: dict[str, Any], where: str) -> Model:
    """Return a table of a file. Raises InputError that begins with `where` for one with errors."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{where}: {explain(error, data, model)}") from error


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


def _sentence(
    location: tuple[int | str, ...], branches: list[ErrorDetails], data: dict[str, Any], keys: list[str]
) -> str:
    problem, key = branches[0], printable(_dotted(location, data), LONGEST)
    error_type = problem["type"]
    if error_type == "extra_forbidden":
        return f"unknown key '{key}'; {_nearest(location, keys)}"
    if error_type == "missing":
        from_others = DERIVED.get(key.rsplit(".", 1)[-1], "")
        return f"the key '{key}' is missing and has no default; add it{from_others}"
    message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
    if error_type in EXPECTED:
        every = [EXPECTED[each["type"]].format(**each.get("ctx", {})) for each in branches if each["type"] in EXPECTED]
        message = f"expected {' or '.join(dict.fromkeys(every))}"
    if error_type in ("model_type", "dict_type"):
        inside = [known.rsplit(".", 1)[-1] for known in _inside(_bare(location), keys)]
        message = f"expected a table, whose keys are {named(inside)}"
    if key == "camera.lens" and error_type != "value_error":
        message = "expected a table [[camera.lens]] for each lens type"
    if "got" not in message:
        message = f"{message}, got {shortened_repr(problem['input'])}"
    if isinstance(problem["input"], str) and DECIMAL_COMMA.fullmatch(problem["input"].strip()):
        message += "; decimals take a point"
    return f"{key}: {message}" if key else message


def _bare(location: tuple[int | str, ...]) -> str:
    return ".".join(part for part in location if isinstance(part, str))[-LONGEST:]


def _inside(table: str, keys: list[str]) -> list[str]:
    """Return the keys of a table, not those of tables in it."""
    before = f"{table}." if table else ""
    return [key for key in keys if key.startswith(before) and "." not in key.removeprefix(before)]


def _nearest(location: tuple[int | str, ...], keys: list[str]) -> str:
    """Return the nearest known key in words: of the same name elsewhere, alike, or all of the same table."""
    bare = _bare(location)
    table, _, last = bare.rpartition(".")
    elsewhere = [known for known in keys if known.rsplit(".", 1)[-1] == last]
    beside = {known.rsplit(".", 1)[-1]: known for known in _inside(table, keys)}
    near = [known for name, known in beside.items() if len(last) >= SHORTEST and name.startswith(last)]
    near += [beside[name] for name in difflib.get_close_matches(last, beside, n=1, cutoff=0.5)]
    found = elsewhere or near or difflib.get_close_matches(bare, keys, n=1, cutoff=0.8)
    if found or not beside:
        nearest = (found or difflib.get_close_matches(bare, keys, n=1, cutoff=0.0))[0]
        return f"the nearest known key is '{nearest}'"
    return f"the keys there are {named(beside)}"


def _key_of(location: tuple[int | str, ...], keys: list[str]) -> tuple[int | str, ...]:
    """Return a location without the branches of unions and the types of tuples, which pydantic appends."""
    found: list[int | str] = []
    for part in location:
        if isinstance(part, int) or _bare((*found, part)) in keys:
            found.append(part)
    return tuple(found)


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
