"""TOML as scenes and lens files are written in it: no number longer than 64 bits, no table deeper than a scene goes."""

from __future__ import annotations

import tomllib
from typing import Any, cast

DEEPEST = 16  # tables in tables; a scene goes down to camera.lens[0].surfaces[0].radius


def loads(text: str) -> dict[str, Any]:
    """The tables in a text. Raises ValueError that says what is wrong with it, and where that is known."""
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(f"its brackets go deeper than {DEEPEST} tables") from error
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # of Python, about digits
        raise ValueError("a number has thousands of digits") from error
    check(data)
    return data


def check(data: dict[str, Any]) -> None:
    """Raise ValueError for whole numbers beyond 64 bits, which are no TOML, and for tables too deep."""
    waiting: list[tuple[Any, int]] = [(data, 0)]
    while waiting:  # without recursion, which is what too much depth would break
        value, depth = waiting.pop()
        if depth > DEEPEST:
            raise ValueError(f"its tables go deeper than {DEEPEST}")
        if isinstance(value, dict | list):
            inner = cast(Any, value).values() if isinstance(value, dict) else cast(Any, value)
            waiting += [(one, depth + 1) for one in inner]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ValueError("a whole number does not fit into 64 bits")
