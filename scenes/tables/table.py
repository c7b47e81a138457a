"""The base of every table of the scene file: frozen, without unknown keys or values of another type."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ConfigDict

LARGEST = 1e12  # of a pixel value: files hold float32, and squares of values must fit too


class Table(BaseModel):
    """A table of the scene file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def allow_absent(schema: dict[str, Any], keys: Iterable[str]) -> None:
    """Let a scene file omit keys, in the JSON Schema of a table; reading the file derives them from others."""
    schema["required"] = [key for key in schema.get("required", ()) if key not in keys]
