"""Tables of campaigns in Markdown, and the cells of one that failed."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from ommatid.runtime.study import FAILED, Row


def markdown(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table whose first column is of names, and the others of numbers."""
    every = [heads, ["---", *["---:"] * (len(heads) - 1)], *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in every)


def say_failed(row: Row, new: bool) -> None:
    """Say on stderr which cell failed, and why."""
    if new and FAILED in row:
        print(row, file=sys.stderr, flush=True)
