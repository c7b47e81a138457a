"""The base of the types that JSON documents are written from and read into."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Amount = Annotated[float, Field(ge=0, le=1e100)]  # a squared error, or a time in seconds
Index = Annotated[int, Field(ge=0, lt=2**31)]


class Record(BaseModel):
    """A part of run.json; frozen, and built from keywords, from JSON or from an object with these attributes."""

    model_config = ConfigDict(frozen=True, from_attributes=True, allow_inf_nan=False)

    def plain(self) -> dict[str, Any]:
        """Return the fields that were set, in JSON's types."""
        return self.model_dump(mode="json", exclude_unset=True)
