"""Results of runs on disk: a journal for each cell, with a line for each run."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from ...journal import append as append_entries
from ...journal import entries
from .cell import Cell
from .run import Failure, Run


def append(folder: Path, cell: Cell, result: Run | Failure) -> None:
    """Append the result of a run."""
    append_entries(_path(folder, cell), {"definition": cell.definition, **result.model_dump()})


def results(folder: Path, cell: Cell) -> dict[int, Run | Failure]:
    """Read the results of a cell by number, the last of each; those of another definition of the cell do not count."""
    read: dict[int, Run | Failure] = {}
    for entry in entries(_path(folder, cell)):
        if entry.pop("definition", None) == cell.definition:
            with suppress(ValidationError):
                result = (Failure if "error" in entry else Run).model_validate(entry)
                read[result.number] = result
    return dict(sorted(read.items()))


def _path(folder: Path, cell: Cell) -> Path:
    return folder / f"{cell.name}.jsonl"
