"""The command `python -m tests.benchmarks coverage`: run the cells that are not complete, and print the table."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from .cell import Cell
from .cells import CELLS
from .journal import append, results
from .run import Failure, Run, measured_run
from .statistics import markdown, statistics

FEW = "†"


def command(arguments: Sequence[str]) -> None:
    """Run the benchmark with the options of its command line."""
    options = _options(arguments)
    cells = _chosen(options.cells)
    if options.list:
        for cell in cells:
            print(_described(cell, options.seeds))
        hours = sum(cell.seconds * (options.seeds or cell.seeds) for cell in cells) / 3600
        print(f"{len(cells)} cells, some {hours:.1f} hours on two cores")
        return
    if not options.table:
        for cell in cells:
            complete(cell, options.out, options.seeds or cell.seeds)
    print(table(cells, options.out))


def _options(arguments: Sequence[str]) -> Namespace:
    parser = ArgumentParser("python -m tests.benchmarks coverage", description="How often error bars are correct.")
    parser.add_argument("-o", "--out", type=Path, default=Path("coverage"), help="folder of the results; default: here")
    parser.add_argument("--cells", default="", metavar="NAME,...", help="cells to run; default: all")
    parser.add_argument("--seeds", type=int, metavar="N", help="runs per cell; default: 20, in some cells 40")
    parser.add_argument("--list", action="store_true", help="list the cells and run nothing")
    parser.add_argument("--table", action="store_true", help="print the table of the results in the folder, no more")
    return parser.parse_args(arguments)


def _chosen(names: str) -> list[Cell]:
    """Return the named cells. Raises SystemExit for an unknown one."""
    by_name = {cell.name: cell for cell in CELLS}
    chosen = [name.strip() for name in names.split(",") if name.strip()] or list(by_name)
    unknown = [name for name in chosen if name not in by_name]
    if unknown:
        raise SystemExit(f"{unknown[0]!r} is not a cell; see python -m tests.benchmarks coverage --list")
    return [by_name[name] for name in chosen]


def _described(cell: Cell, seeds: int | None) -> str:
    lenses = f" --lens {','.join(cell.lenses)}" if cell.lenses else ""
    changes = "".join(f" --set '{change}'" for change in cell.changes)
    image = ", images drawn from the prior" if cell.drawn else ""
    return f"{cell.name}: {seeds or cell.seeds} runs of {cell.seconds:g} s{image}: {cell.scene}{lenses}{changes}"


def complete(cell: Cell, folder: Path, seeds: int) -> None:
    """Run what is missing of the first `seeds` runs of a cell, and those that failed; append each to its file."""
    finished = [number for number, result in results(folder, cell).items() if isinstance(result, Run)]
    for number in range(seeds):
        if number in finished:
            continue
        result = measured_run(cell, number)
        append(folder, cell, result)
        print(f"{cell.name} {number}: {_line(result)}", file=sys.stderr, flush=True)


def _line(result: Run | Failure) -> str:
    if isinstance(result, Failure):
        return result.error
    place = {True: "inside", False: "OUTSIDE", None: "no interval"}[result.inside]
    verdict = "trusted" if result.trusted else "red"
    ratio = result.mse / result.promised if result.promised > 0 else float("nan")
    return f"error {result.mse:.4g}, {ratio:.3f} of the promise, {place}, {verdict}, {result.seconds:.1f} s"


def table(cells: Sequence[Cell], folder: Path) -> str:
    """Return the table of the cells that have results in the folder, in Markdown, and a sentence on those that fail."""
    known = [(cell, list(results(folder, cell).values())) for cell in cells]
    judged = [(cell, statistics(found)) for cell, found in known if found]
    rows = [found.row(_marked(cell)) for cell, found in judged]
    failing = [
        f"{_marked(cell)} ({found.inside} of {found.judged} inside, {found.red} of {found.runs} red)"
        for cell, found in judged
        if not found.holds
    ]
    sentence = f"Too many errors are outside in {len(failing)} of {len(judged)} cells{': ' if failing else ''}"
    return f"{markdown(rows)}\n\n{sentence}{', '.join(failing)}. {FEW} fewer samples than the scene asks for."


def _marked(cell: Cell) -> str:
    """Return the name of a cell, marked if the samples of its H are fewer than those of the scene."""
    return f"{cell.name} {FEW}" if cell.has_few_samples else cell.name
