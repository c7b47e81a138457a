"""Benchmarks of rendering and estimation against other methods: `python -m tests.benchmarks`.

`python -m tests.benchmarks frames` runs one part; the parts are `rendering` and `frames`. No speed is asserted, and
other load slows both sides of a ratio alike, so compare ratios rather than times. Run by themselves: `chain`, the time,
memory and files of every stage of a run from 119 x 119 pixels on, and the campaigns, which continue where they were
interrupted: `nasty`, half an hour, `pictures`, which measures error bars of eleven kinds of picture for two hours, and
`coverage`, those of rendered scenes for eight (`coverage --help`). `cells` says in two minutes what is served.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from rich.console import Console
from rich.table import Table

from .camera import camera_table
from .cells import command as cells
from .chain import command as chain
from .coverage import command as coverage
from .frames import frames_tables
from .nasty import command as nasty
from .pictures import command as pictures

NARROWEST = 160
PARTS: dict[str, Callable[[], Iterable[Table]]] = {"rendering": lambda: [camera_table()], "frames": frames_tables}
ALONE: dict[str, Callable[[list[str]], None]] = {
    "cells": cells,
    "chain": chain,
    "coverage": coverage,
    "nasty": nasty,
    "pictures": pictures,
}


def main() -> None:
    """Run the parts that are named on the command line, or all, and print each table as soon as it is complete."""
    if sys.argv[1:2] and sys.argv[1] in ALONE:
        ALONE[sys.argv[1]](sys.argv[2:])
        return
    names = sys.argv[1:] or list(PARTS)
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise SystemExit(
            f"{unknown[0]!r} is not a part of the benchmarks; expected one of {', '.join(ALONE)},"
            f" or some of {', '.join(PARTS)}"
        )
    console = Console()
    console.width = max(console.width, NARROWEST)  # a pipe has 80 columns, which break every cell
    for name in names:
        for table in PARTS[name]():
            console.print(table)


if __name__ == "__main__":
    main()
