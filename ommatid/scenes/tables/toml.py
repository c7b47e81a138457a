"""TOML of scenes and lens files, and changes to its tables from the command line: `--set key=value`, `--lens I,II`.

Integers have 64 bits, and tables are no deeper than a scene needs.
"""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

from ommatid.runtime.errors import InputError, named, shortened, shortened_repr

Change = str | tuple[str, Any]  # KEY=VALUE, or a key and its value, None to remove the key
DEEPEST = 16  # levels of nested tables; a scene has camera.lens[0].surfaces[0].radius
LARGEST = 4_000_000  # bytes; parsing takes 30 times as much memory
MOST_VALUES = 200_000
DEEPEST_KEY = 1000  # dots of a key: the parser's time grows as their square
SHORT = 10_000  # bytes of a text that has no time to grow
TOKEN = re.compile(
    r'"{3}(?:[^"\\]|\\.|"(?!""))*(?:"{3})?|'
    r"'{3}(?:[^']|'(?!''))*(?:'{3})?|"
    r'"(?:[^"\\\n]|\\.)*"?|'
    r"'[^'\n]*'?|#[^\n]*|[.\n,=\[\]{}]",
    re.DOTALL,
)  # strings and comments, which may end at the end of the text, dots, and what separates keys and values


def loads(text: str) -> dict[str, Any]:
    """Parse a text. Raises ValueError that says what is wrong and, if known, in which line."""
    text = text.removeprefix("\ufeff")
    _check_keys(text)
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(f"its brackets go deeper than {DEEPEST} tables") from error
    except tomllib.TOMLDecodeError as error:
        raise ValueError(_with_line(text, str(error))) from error
    except ValueError as error:  # from int() of too many digits
        raise ValueError("a number has thousands of digits") from error
    check(data)
    return data


def _with_line(text: str, message: str) -> str:
    """Return a message of the parser with the line that it is about, and what mostly is wrong there."""
    place = re.search(r" \(at line (\d+), column \d+\)", message)
    if place is None:
        return shortened(message)
    line = text.splitlines()[int(place[1]) - 1 : int(place[1])]
    if not line or not line[0].strip():
        return shortened(message)
    reason = shortened(message.replace(place[0], ""))
    return f"line {place[1]}, {shortened(line[0].strip())}: {reason}; texts and quantities take quotation marks"


def _check_keys(text: str) -> None:
    """Raise ValueError for a key of so many parts that parsing it would take minutes."""
    dots = 0
    for token in TOKEN.finditer(text) if len(text) > SHORT else ():
        if token[0] == ".":
            dots += 1
            if dots > DEEPEST_KEY:
                raise ValueError(f"a key goes deeper than {DEEPEST} tables")
        elif token[0] in "\n,=[]{}":
            dots = 0


def dumps(data: dict[str, Any]) -> str:
    """Return data as TOML; characters that do not print are written as escapes, which `loads` reads again."""
    import tomli_w

    return re.sub(r"[^\x00-\x7e]", _escaped, tomli_w.dumps(data))


def _escaped(match: re.Match[str]) -> str:
    character = match[0]
    return character if character.isprintable() else f"\\U{ord(character):08x}"


def check(data: dict[str, Any]) -> None:
    """Raise ValueError for integers beyond 64 bits, which TOML does not have, and for tables nested too deeply."""
    waiting: list[tuple[Any, int]] = [(data, 0)]
    values = 0
    while waiting:  # not recursive, since deep nesting would exceed the recursion limit
        value, depth = waiting.pop()
        values += 1
        if depth > DEEPEST:
            raise ValueError(f"its tables go deeper than {DEEPEST}")
        if values > MOST_VALUES:
            raise ValueError(f"it has more than {MOST_VALUES} values")
        if isinstance(value, dict | list):
            inner = cast(Any, value).values() if isinstance(value, dict) else cast(Any, value)
            waiting += [(item, depth + 1) for item in inner]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ValueError("a whole number does not fit into 64 bits")


EVERY = "*"  # in place of the name of a lens type
FILES = {  # first and last part of the keys that name files
    ("target", "image"),
    ("world", "file"),
    ("light", "spectrum"),
    ("sensor", "quantum_efficiency"),
    ("camera", "glass_catalogue"),
    ("camera", "surfaces"),
}


def apply_overrides(data: dict[str, Any], overrides: Iterable[Change]) -> dict[str, Any]:
    """A copy with keys set, such as `noise.variance=1e-6` or `camera.lens.II.pixels=[2,2]`; an empty value removes one.

    `camera.lens.*.aperture=1 mm` sets that of every lens type. Values are read as by `value_of`; names of files are
    relative to the current folder. Raises InputError if a lens type of a key does not exist.
    """
    changed = copy.deepcopy(data)
    for given in overrides:
        key, value = _assignment(given) if isinstance(given, str) else given
        option = option_of(given)
        *tables, last = [part.strip() for part in key.split(".")]
        if len(tables) > DEEPEST:
            raise InputError(f"{option}: its key goes deeper than {DEEPEST} tables")
        found: list[Any] = [changed]
        for name in tables:
            found = [inner for table in found for inner in _inside(table, name, option)]
        for table in found:
            if not isinstance(table, dict):
                raise InputError(f"{option}: '{'.'.join(tables)}' is not a table, so it has no key '{last}'")
            if value is None:
                table.pop(last, None)  # pyright: ignore[reportUnknownMemberType]
            else:
                table[last] = _from_here([*tables, last], value)
    return changed


def _assignment(text: str) -> tuple[str, Any]:
    """Return the key and the value, None without one, of KEY=VALUE. Raises InputError for another text."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {shortened(text)}: expected KEY=VALUE, such as noise.variance=1e-6")
    if any(0xD800 <= ord(character) < 0xE000 for character in text):
        raise InputError(f"--set {shortened(text)}: expected text in UTF-8, got other bytes")
    return key, value_of(value) if value.strip() else None


def option_of(change: Change) -> str:
    """Return a change in words, as an error names it: the option `--set`, or `set` for values of Python."""
    return f"--set {shortened(change)}" if isinstance(change, str) else f"set {shortened('='.join(map(str, change)))}"


def options_by_key(changes: Iterable[Change]) -> dict[str, str]:
    """Return the changes in words by the dotted keys that they set or remove."""
    options = dict[str, str]()
    for change in changes:
        key = change.partition("=")[0] if isinstance(change, str) else change[0]
        options[".".join(part.strip() for part in key.split("."))] = option_of(change)
    return options


def changes_of(values: Mapping[str, object]) -> list[Change]:
    """Return the changes that set keys to values of Python, of NumPy included. Raises InputError for other objects."""
    changes: list[Change] = []
    for key, value in values.items():
        try:
            plain = None if value is None else _plain(value)
            check({"value": plain})
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(
                f"set: {shortened(str(key))}: expected a number, a text, a truth value, a list or a table, got"
                f" {shortened_repr(value)}"
            ) from error
        changes.append((str(key), plain))
    return changes


def _plain(value: Any) -> Any:
    """Return a value in TOML's types. Raises TypeError for one that has none."""
    value = value.tolist() if hasattr(value, "tolist") else value  # of NumPy
    if isinstance(value, list | tuple):
        return [_plain(item) for item in cast(list[Any], value)]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in cast(dict[Any, Any], value).items() if item is not None}
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path | Fraction):
        return str(value)
    raise TypeError(f"expected one of TOML's types, got {type(value)}")


def _inside(table: Any, name: str, option: str) -> list[Any]:
    """Return the tables that a part of a key names: one, or for `*` those of all lens types."""
    if isinstance(table, list):
        lenses = _by_name(table)  # pyright: ignore[reportUnknownArgumentType]
        if name == EVERY:
            return list(lenses.values())
        if name not in lenses:
            known = named(lenses, "'")
            raise InputError(f"{option}: no lens type is called '{name}'; there are {known}")
        return [lenses[name]]
    if not isinstance(table, dict):
        raise InputError(f"{option}: '{name}' is not in a table")
    return [table.setdefault(name, {})]  # pyright: ignore[reportUnknownMemberType]


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
        return loads(f"value = {text}")["value"]
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
            known = named(lenses, "'")
            raise InputError(f"--lens {','.join(names)}: no lens type is called '{name}'; there are {known}")
        earlier = names[:index].count(name)
        chosen.append({**lenses[name], "name": name if earlier == 0 else f"{name}-{earlier + 1}"})
    return {**data, "camera": {**camera, "lens": chosen}}  # type: ignore[dict-item]


def _by_name(lenses: list[Any]) -> dict[str, Any]:
    return {str(lens.get("name")): lens for lens in lenses if isinstance(lens, dict)}  # type: ignore[union-attr]
