"""What every table of the scene file has in common: it is frozen and takes no unknown key, no value of another kind."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

LARGEST = 1e12  # of a value: files hold float32, and squares of values have to fit as well


class Table(BaseModel):
    """A table of the scene file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
