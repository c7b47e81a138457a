"""Results of runs on disk: a file per cell, one JSON line per run, so that an interrupted benchmark goes on."""

from __future__ import annotations

import json
import os
from pathlib import Path

from pydantic import ValidationError

from .cell import Cell
from .run import Failure, Run


def append(folder: Path, cell: Cell, result: Run | Failure) -> None:
    """Append the result of a run in one write; an unfinished line of an interrupted write stays by itself."""
    path = _path(folder, cell)
    folder.mkdir(parents=True, exist_ok=True)
    line = json.dumps({"definition": cell.definition, **result.model_dump()}) + "\n"
    with path.open("ab+") as file:
        if file.seek(0, os.SEEK_END) > 0:
            file.seek(-1, os.SEEK_END)
            line = line if file.read(1) == b"\n" else "\n" + line
        file.write(line.encode())


def results(folder: Path, cell: Cell) -> dict[int, Run | Failure]:
    """Read the results of a cell by number, the last of each; those of another definition of the cell do not count."""
    path, definition = _path(folder, cell), cell.definition
    read: dict[int, Run | Failure] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        result = _result(line, definition)
        if result is not None:
            read[result.number] = result
    return dict(sorted(read.items()))


def _result(line: str, definition: str) -> Run | Failure | None:
    """Return the result in a line; None for an unfinished line and for one of another definition."""
    try:
        content = json.loads(line)
        if content.pop("definition") != definition:
            return None
        return (Failure if "error" in content else Run).model_validate(content)
    except (ValueError, KeyError, AttributeError, ValidationError):
        return None


def _path(folder: Path, cell: Cell) -> Path:
    return folder / f"{cell.name}.jsonl"
