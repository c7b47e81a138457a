"""What became of a sweep: a table with a row a scene, as CSV and JSON, and a plot of its errors.

Squared errors are in squared units of f, seconds are those of the stages.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ommatid.runtime.files import clear_abandoned, make_folder, write_text
from ommatid.scenes.tables.overrides import value_of

TABLE, NUMBERS, PICTURE = "sweep.csv", "sweep.json", "sweep.png"
ERRORS = ("mse", "predicted_mse", "psnr", "ssim")
FIELDS = (
    "mse",
    "expected_mse",
    "expected_low",
    "expected_high",
    "predicted_mse",
    "psnr",
    "ssim",
    "budget.",
    "rank",
    "null_space",
    "condition",
    "seconds.",
    "measurements",
    "unknowns",
    "failed",
)


def summary(document: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the table: what a run, a rendering or a prediction says in numbers, or why there is none.

    document : with `scene`, `values` as they were written, `folder` if there is one, and what the command says of it
    """
    row: dict[str, Any] = {name: document[name] for name in ("scene", "folder", "values") if name in document}
    error: Any = document.get("error", {})
    if isinstance(error, str):
        return {**row, "failed": error}
    if "rank" in document:  # of a prediction, whose error is the expected one
        error = {"predicted_mse": document["mse"]}
    row |= {name: error[name] for name in ERRORS if error.get(name) is not None}
    row |= {f"expected_{name}": value for name, value in error.get("expected_given_truth", {}).items()}
    row |= {f"budget.{name}": value for name, value in error.get("budget", {}).items()}
    row |= {f"seconds.{name}": stage.get("seconds") for name, stage in document.get("stages", {}).items()}
    if "seconds" in document:
        row["seconds.render"] = document["seconds"]
    names = ("rank", "null_space", "condition", "measurements", "unknowns")
    return row | {name: document[name] for name in names if document.get(name) is not None}


def write_sweep(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write sweep.csv and sweep.json and, where there are errors to show, sweep.png. Raises DeniedError."""
    from .sweep_figure import write_figure

    make_folder(folder)
    clear_abandoned(folder)
    if any("predicted_mse" in row for row in rows):
        write_figure(folder / PICTURE, rows)
    write_text(folder / TABLE, _csv(rows))
    told = [{**row, "values": {key: _for_json(text) for key, text in row["values"].items()}} for row in rows]
    write_text(folder / NUMBERS, json.dumps(told, indent=2, allow_nan=False) + "\n")


def lines(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """The lines of the printed table: the values of a scene, and its errors."""
    found: list[tuple[str, str]] = []
    several = len({row["scene"] for row in rows}) > 1
    for row in rows:
        named = [Path(row["scene"]).stem] if several else []
        named += [f"{key} = {value}" for key, value in row["values"].items()]
        told = [f"{name.replace('_', ' ')} {row[name]:.4g}" for name in ("mse", "predicted_mse") if name in row]
        told += [f"null space {row['null_space']}"] if "null_space" in row else []
        found.append((", ".join(named), row.get("failed") or ", ".join(told) or "done"))
    return found


def _for_json(text: str) -> Any:
    """A value as `--set` reads it; what JSON does not know, such as nan or a date, as it was written."""
    value = value_of(text)
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return text
    return value


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Swept keys first; columns that no row has are left out."""
    flat = [{**row, **row["values"]} for row in rows]
    there = list(dict.fromkeys(name for row in rows for name in row))
    columns = [name for field in FIELDS for name in there if name == field or field == f"{name.split('.')[0]}."]
    text = io.StringIO()
    first = [name for name in ("scene", "folder") if name in there]
    writer = csv.DictWriter(text, [*first, *rows[0]["values"], *columns], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()
