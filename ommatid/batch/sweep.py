"""A sweep: a scene for every combination of values of some keys, each with a folder of its own.

`--sweep noise.variance=1e-6,1e-4 --sweep camera.lens.I.magnification=1/2,1/3` makes four of one. Values are read as
those of `--set`.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from pydantic import ValidationError

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read

from .batch import Member

EXAMPLE = "such as --sweep noise.variance=1e-6,1e-4"
LONGEST = 40  # characters of a value in the name of a folder
_PAIRS = {"]": "[", "}": "{", ")": "("}


@dataclass(frozen=True)
class SweepAxis:
    """A key of the scene file, and the values that it takes, as they were written."""

    key: str
    values: tuple[str, ...]


def sweep_axes(options: Iterable[str]) -> tuple[SweepAxis, ...]:
    """Read KEY=VALUE,VALUE,... of every `--sweep`. Raises InputError that names the one that cannot be read."""
    found: list[SweepAxis] = []
    for option in options:
        key, equals, text = (part.strip() for part in option.partition("="))
        values = tuple(_split(text))
        if not key or not equals or not all(values):
            raise InputError(f"--sweep {option}: expected KEY=VALUE,VALUE,... without an empty value, {EXAMPLE}")
        twice = [value for value in values if values.count(value) > 1]
        if twice:
            raise InputError(f"--sweep {option}: expected every value once, got '{twice[0]}' twice")
        if key in {axis.key for axis in found}:
            raise InputError(f"--sweep {option}: expected every key once, got '{key}' twice; join its values by commas")
        found.append(SweepAxis(key, values))
    return tuple(found)


def members(scenes: Sequence[Path], swept: Sequence[SweepAxis], output: Path) -> list[Member]:
    """Every scene with every combination of values, in folders of `output` that are named after them.

    Raises InputError where two would share a folder.
    """
    names = [_names(axis) for axis in swept]
    found: dict[Path, Member] = {}
    for scene, values in product(scenes, product(*(axis.values for axis in swept))):
        told = [f"{_safe(axis.key)}={name[value]}" for axis, name, value in zip(swept, names, values, strict=True)]
        folder = output / "+".join([scene.stem, *told])
        if folder in found:
            raise InputError(f"{folder}: two scenes of the batch are called '{scene.stem}'; rename one of them")
        changes = tuple(f"{axis.key}={value}" for axis, value in zip(swept, values, strict=True))
        found[folder] = Member(scene, folder, changes)
    return list(found.values())


def check_keys(scene: Path, swept: Sequence[SweepAxis], changes: Sequence[str], lenses: Sequence[str]) -> None:
    """Raise InputError if the scene file has no such key as one that is swept.

    What else is wrong with it, or with a value, is told of every scene by itself.
    """
    if _cannot_be_set(scene, changes, lenses, None):
        return
    for axis in swept:
        error = _cannot_be_set(scene, (*changes, f"{axis.key}={axis.values[0]}"), lenses, axis.key)
        if error:
            raise InputError(f"--sweep {axis.key}: {error}")


def _cannot_be_set(scene: Path, changes: Sequence[str], lenses: Sequence[str], key: str | None) -> InputError | None:
    """Why changes lead nowhere: to no table, or to a `key` that the scene file does not know."""
    try:
        read(scene, changes, lenses)
    except InputError as error:
        cause = error.__cause__
        if isinstance(cause, InputError):
            return error
        if key is not None and isinstance(cause, ValidationError):
            unknown = [problem["loc"][-1] for problem in cause.errors() if problem["type"] == "extra_forbidden"]
            return error if set(unknown) & set(key.split(".")) else None
    return None


def _split(text: str) -> list[str]:
    """At commas outside brackets and quotation marks: "[2,2],[3,3]" are two values."""
    parts, open_, quote = [""], [""], ""
    for letter in text:
        if letter == "," and not quote and len(open_) == 1:
            parts.append("")
            continue
        parts[-1] += letter
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in _PAIRS.values():
            open_.append(letter)
        elif open_[-1] == _PAIRS.get(letter):
            open_.pop()
    return [part.strip() for part in parts]


def _names(axis: SweepAxis) -> dict[str, str]:
    """Values as parts of a folder's name: what would be the same for two of them, or is too long, ends in a hash."""
    plain = {value: _safe(value) for value in axis.values}
    texts = list(plain.values())
    return {
        value: text
        if texts.count(text) == 1 and 0 < len(text) <= LONGEST
        else f"{text[:LONGEST]}~{hashlib.sha256(value.encode()).hexdigest()[:6]}"
        for value, text in plain.items()
    }


def _safe(text: str) -> str:
    """In letters that every file system takes: 1/3 becomes 1-3, [2, 2] becomes 2,2."""
    return re.sub(r"[^A-Za-z0-9._,=-]", "_", re.sub(r"[\s\"'+\[\]]", "", text).replace("/", "-"))
