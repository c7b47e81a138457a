"""Changes to a scene's tables from the command line: `--set key=value` and `--lens I,II`."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ommatid.runtime.errors import InputError, shortened

from . import toml

MOST_NAMED = 10  # lens types in a message
FILES = {  # first and last part of the keys that name files
    ("target", "image"),
    ("world", "file"),
    ("light", "spectrum"),
    ("sensor", "quantum_efficiency"),
    ("camera", "glass_catalogue"),
    ("camera", "surfaces"),
}


def apply_overrides(data: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """A copy with keys set, such as `noise.variance=1e-6` or `camera.lens.II.pixels=[2,2]`; an empty value removes one.

    Values are read as by `value_of`; names of files are relative to the current folder. Raises InputError if a lens
    type of a key does not exist.
    """
    changed = copy.deepcopy(data)
    for assignment in overrides:
        key, equals, text = assignment.partition("=")
        override = shortened(assignment)
        if not equals or not key.strip():
            raise InputError(f"--set {override}: expected KEY=VALUE, such as noise.variance=1e-6")
        if any(0xD800 <= ord(character) < 0xE000 for character in assignment):
            raise InputError(f"--set {override}: expected text in UTF-8, got other bytes")
        *tables, last = [part.strip() for part in key.split(".")]
        if len(tables) > toml.DEEPEST:
            raise InputError(f"--set {override}: its key goes deeper than {toml.DEEPEST} tables")
        table: Any = changed
        for name in tables:
            table = _inside(table, name, override)
        if not isinstance(table, dict):
            raise InputError(f"--set {override}: '{'.'.join(tables)}' is not a table, so it has no key '{last}'")
        if text.strip():
            table[last] = _from_here([*tables, last], value_of(text))
        else:
            table.pop(last, None)  # pyright: ignore[reportUnknownMemberType]
    return changed


def _inside(table: Any, name: str, override: str) -> Any:
    if isinstance(table, list):
        lenses = _by_name(table)  # pyright: ignore[reportUnknownArgumentType]
        if name not in lenses:
            raise InputError(f"--set {override}: no lens type is called '{name}'; there are {_names(lenses)}")
        return lenses[name]
    if not isinstance(table, dict):
        raise InputError(f"--set {override}: '{name}' is not in a table")
    return table.setdefault(name, {})  # type: ignore[return-value]


def _from_here(key: list[str], value: Any) -> Any:
    """Return names of files relative to the current folder as absolute ones, also those inside tables."""
    if isinstance(value, dict):
        return {name: _from_here([*key, name], inner) for name, inner in value.items()}  # type: ignore[union-attr]
    if isinstance(value, list):  # names of files are in lists of tables only; a curve's list may hold "450 nm"
        return [_from_here(key, item) if isinstance(item, dict) else item for item in value]  # type: ignore[union-attr]
    if not isinstance(value, str) or not value.strip() or (key[0], key[-1]) not in FILES:
        return value
    is_name = value.startswith("photo:") or (key[-1] == "spectrum" and (value.endswith("nm") or not Path(value).suffix))
    return value if is_name else str(Path.cwd() / value)


def value_of(text: str) -> Any:
    """The value of a text from the command line: parsed as TOML if possible, else the text itself."""
    try:
        return toml.loads(f"value = {text}")["value"]
    except ValueError:
        return text.strip()


def keep_lenses(data: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Keep the named lens types in the given order; a name given twice adds a copy called NAME-2.

    Without names, `data` is returned unchanged. Raises InputError for an unknown name.
    """
    names = list(names)
    if not names:
        return data
    camera = data.get("camera")
    listed: Any = camera.get("lens") if isinstance(camera, dict) else None  # type: ignore[union-attr]
    lenses = _by_name(listed) if isinstance(listed, list) else {}  # pyright: ignore[reportUnknownArgumentType]
    chosen: list[Any] = []
    for index, name in enumerate(names):
        if name not in lenses:
            raise InputError(f"--lens {','.join(names)}: no lens type is called '{name}'; there are {_names(lenses)}")
        earlier = names[:index].count(name)
        chosen.append({**lenses[name], "name": name if earlier == 0 else f"{name}-{earlier + 1}"})
    return {**data, "camera": {**camera, "lens": chosen}}  # type: ignore[dict-item]


def _by_name(lenses: list[Any]) -> dict[str, Any]:
    return {str(lens.get("name")): lens for lens in lenses if isinstance(lens, dict)}  # type: ignore[union-attr]


def _names(lenses: Iterable[str]) -> str:
    known = [f"'{shortened(name)}'" for name in lenses]
    more = [f"{len(known) - MOST_NAMED} more"] if len(known) > MOST_NAMED else []
    return ", ".join([*known[:MOST_NAMED], *more]) or "none"
