"""TOML of scenes and lens files: integers of 64 bits, tables no deeper than a scene needs."""

from __future__ import annotations

import re
import tomllib
from typing import Any, cast

from ommatid.runtime.errors import shortened

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
        raise ValueError(shortened(str(error))) from error
    except ValueError as error:  # from int() of too many digits
        raise ValueError("a number has thousands of digits") from error
    check(data)
    return data


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
