"""Rows of a sweep's table, and sweep.json, which holds them.

Squared errors are in squared units of f; seconds are those of the stages.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from ommatid.runtime.files import write_text
from ommatid.runtime.input_files import read_record
from ommatid.scenes.tables.toml import value_of

NUMBERS = "sweep.json"


class SweepRow(BaseModel):
    """Result of one scene of a sweep. Numbers that its command does not give are None; `failed` is the reason.

    values : of the swept keys; in memory as they were written, in sweep.json as the scene file has them
    expected_mse, expected_low, expected_high : expectation given the true image, and its 99 % interval
    predicted_mse : Eq. 5;  rms, predicted_rms : roots of the mean squared errors, in grey levels
    gain : dB over the best single sub-image;  trusted : the verdict
    Parts of the budget and seconds of the stages are further columns, `budget.rendering` and `seconds.render`.
    The order of the fields is that of the columns of sweep.csv.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    scene: str
    folder: str | None = None
    values: dict[str, Any]
    trusted: bool | None = None
    mse: float | None = None
    rms: float | None = None
    expected_mse: float | None = None
    expected_low: float | None = None
    expected_high: float | None = None
    predicted_mse: float | None = None
    predicted_rms: float | None = None
    psnr: float | None = None
    ssim: float | None = None
    gain: float | None = None
    rank: int | None = None
    null_space: int | None = None
    condition: float | None = None
    measurements: int | None = None
    unknowns: int | None = None
    failed: str | None = None

    def flat(self) -> dict[str, Any]:
        """The row as in the files: None is left out."""
        return self.model_dump(exclude_none=True)


def summary(document: Mapping[str, Any]) -> SweepRow:
    """Row of a scene from what `run`, `render` or `predict` prints as JSON, or from its failure.

    document : with `scene`, `values` as they were written, and `folder` if there is one
    """
    where: dict[str, Any] = {name: document[name] for name in ("scene", "folder", "values") if name in document}
    error: Any = document.get("error", {})
    if isinstance(error, str):
        return SweepRow(**where, failed=error)
    if "rank" in document:  # a prediction, whose `mse` is the one of Eq. 5
        error = {"predicted_mse": document["mse"]}
    seconds = {name: stage.get("seconds") for name, stage in document.get("stages", {}).items()}
    if "seconds" in document:
        seconds["render"] = document["seconds"]
    numbers: dict[str, Any] = {
        **{name: error.get(name) for name in ("mse", "predicted_mse", "psnr", "ssim", "gain")},
        **{f"{kind}rms": mse**0.5 for kind in ("", "predicted_") if (mse := error.get(f"{kind}mse")) is not None},
        **{f"expected_{name}": value for name, value in error.get("expected_given_truth", {}).items()},
        **{name: document.get(name) for name in ("rank", "null_space", "condition", "measurements", "unknowns")},
    }
    return SweepRow(
        **where,
        **numbers,
        trusted=document.get("verdict", {}).get("trusted"),
        **{f"budget.{name}": part for name, part in error.get("budget", {}).items()},
        **{f"seconds.{name}": value for name, value in seconds.items() if value is not None},
    )


def write_rows(path: Path, rows: Sequence[SweepRow]) -> None:
    """Write sweep.json. Raises MachineError."""
    typed = [{**row.flat(), "values": {key: _for_json(text) for key, text in row.values.items()}} for row in rows]
    write_text(path, json.dumps(typed, indent=2, allow_nan=False) + "\n")


def read_rows(path: Path) -> list[SweepRow]:
    """Read sweep.json. Raises InputError if it is missing, damaged or another file."""
    rows: list[SweepRow] = read_record(path, list[SweepRow], "the table of a sweep", "repeat `ommatid run --sweep`")
    return rows


def _for_json(text: str) -> Any:
    """A value as the scene file has it; one that JSON has no type for, such as nan or a date, as text."""
    value = value_of(text)
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return text
    return value
