"""A study: a row of numbers for each of many cells, kept in a journal, from which an interrupted study goes on.

A cell names what is measured, in JSON's types: values of keys, and a seed. A journal has one JSON line per row.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from .errors import InputError
from .files import not_written, write_csv
from .input_files import read_bytes
from .outputs.kinds import check_output

FAILED = "failed"  # column with the reason why a cell could not be measured

Row = dict[str, Any]


def study(
    journal: Path,
    cells: Iterable[Row],
    measure: Callable[[Row], Row],
    report: Callable[[Row, bool], None] | None = None,
    failure: type[Exception] = InputError,
) -> list[Row]:
    """Return the row of each cell: from the journal, else measured and appended to it.

    measure : returns the numbers of a cell; where it raises `failure`, the row is the cell with the reason under
        `failed`, which no journal keeps
    report : is called with every row, and True if it is new
    """
    kept = [entry for entry in entries(journal) if "cell" in entry and isinstance(entry.get("row"), dict)]
    known = {_identity(entry["cell"]): entry["row"] for entry in kept}
    rows: list[Row] = []
    for cell in cells:
        row = known.get(_identity(cell))
        new = row is None
        if row is None:
            try:
                row = {**cell, **measure(cell)}
                append(journal, {"cell": cell, "row": row})
            except failure as error:
                row = {**cell, FAILED: str(error) or type(error).__name__}
        rows.append(row)
        if report is not None:
            report(row, new)
    return rows


def _identity(cell: Row) -> str:
    return json.dumps(cell, sort_keys=True)


def append(path: Path, *rows: Row) -> None:
    """Append rows to a journal in one write; an unfinished line of an interrupted write stays by itself.

    Raises InputError or MachineError.
    """
    check_output(path)
    lines = "".join(f"{json.dumps(row)}\n" for row in rows)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                lines = lines if file.read(1) == b"\n" else "\n" + lines
            file.write(lines.encode())
    except OSError as error:
        raise not_written(path, error) from error


def entries(path: Path) -> Iterator[Row]:
    """Yield the rows of a journal, none if there is no such file; unfinished lines do not count. Raises InputError."""
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error})") from error
    for line in content.splitlines():
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict):
            yield cast(Row, row)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], first: Iterable[str] = ()) -> None:
    """Write rows as CSV, with the columns that any of them has, those of `first` in that order before others.

    Raises InputError or MachineError.
    """
    present = dict.fromkeys(name for row in rows for name in row)
    columns = list(dict.fromkeys([*(name for name in first if name in present), *present]))
    write_csv(path, columns, ([row.get(name) for name in columns] for row in rows))
