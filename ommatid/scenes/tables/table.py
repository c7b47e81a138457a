"""The base of every table of the scene file: frozen, without unknown keys or values of another type."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

from pydantic import BaseModel, BeforeValidator, ConfigDict

LARGEST = 1e12  # of a pixel value: files hold float32, and squares of values must fit too


class Table(BaseModel):
    """A table of the scene file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def at_most(count: int, what: str) -> BeforeValidator:
    """Convert a list of TOML to a tuple, and refuse one of more than `count` items before they are looked at."""

    def check(value: object) -> object:
        if not isinstance(value, list | tuple):
            return value
        items = cast(Sequence[object], value)
        if len(items) > count:
            raise ValueError(f"expected at most {count} {what}, got {len(items)}")
        return tuple(items)

    return BeforeValidator(check)


def allow_absent(*keys: str) -> Callable[[dict[str, Any]], None]:
    """Let a scene file omit keys, in the JSON Schema of a table; reading the file derives them from others."""

    def drop(schema: dict[str, Any]) -> None:
        schema["required"] = [key for key in schema.get("required", ()) if key not in keys]

    return drop
