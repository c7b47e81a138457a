"""The base of every table of the scene file: frozen, without unknown keys or values of another type."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

LARGEST = 1e12  # of a pixel value: files hold float32, and squares of values must fit too


class Table(BaseModel):
    """A table of the scene file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
