"""Results of campaigns on disk, one JSON line each, so that an interrupted campaign goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def append(path: Path, *entries: dict[str, Any]) -> None:
    """Append entries in one write; an unfinished line of an interrupted write stays by itself."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = "".join(f"{json.dumps(entry)}\n" for entry in entries)
    with path.open("ab+") as file:
        if file.seek(0, os.SEEK_END) > 0:
            file.seek(-1, os.SEEK_END)
            lines = lines if file.read(1) == b"\n" else "\n" + lines
        file.write(lines.encode())


def entries(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the entries of a journal, none if there is no such file; unfinished lines do not count."""
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if isinstance(entry, dict):
            yield entry
