"""Long campaign: `python -m tests.fuzz --inputs 20000 --seed 1 --journal FILE`; or one input of it again.

A campaign that was stopped goes on with the families that its journal lacks.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from ommatid.runtime.study import append, entries

from ..conftest import TINY, shell
from .campaign import campaign, command_for
from .families import FAMILIES, inputs_of
from .family import SCENE
from .verdicts import REFUSED, UNCHANGED, VALID
from .worker import Result

COLUMNS = ("type of input", "damaged", REFUSED, UNCHANGED, VALID, "wrong", "seconds", "slowest")
WIDTH = 120


def finished_run(folder: Path) -> Path:
    """Run the tiny scene and return its folder."""
    (folder / SCENE).write_text(TINY, encoding="utf-8")
    ended = shell("run", SCENE, "-o", "out", cwd=folder)
    if ended.code:
        raise SystemExit(ended.err)
    return folder / "out" / Path(SCENE).stem


def row(name: str, results: list[Result]) -> tuple[str, ...]:
    """Return the table row of a file type."""
    counts = [sum(result.verdict == verdict for result in results) for verdict in (REFUSED, UNCHANGED, VALID)]
    wrong = sum(result.wrong for result in results)
    seconds = [result.seconds for result in results]
    times = f"{sum(seconds):.1f}", f"{max(seconds, default=0.0):.2f}"
    return name, *map(str, (len(results), *counts, wrong)), *times


def main() -> None:
    """Run the campaign over all file types, or over one."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=10000, help="number of inputs of all families together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=sorted(FAMILIES), help="only this family")
    parser.add_argument("--only", type=int, metavar="NUMBER", help="only this input of --kind")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--journal", type=Path, help="file of the results of families that have ended")
    options = parser.parse_args()
    names = [options.kind] if options.kind else list(FAMILIES)
    with tempfile.TemporaryDirectory() as folder:
        finished = finished_run(Path(folder))
        if options.only is not None:
            print(*campaign({names[0]: [options.only]}, options.seed, finished), sep="\n")
            return
        numbers = inputs_of(names, options.inputs) if options.kind is None else {names[0]: range(options.inputs)}
        every = [Result(**entry) for entry in entries(options.journal)] if options.journal else []
        left = [name for name in names if name not in {result.kind for result in every}]
        with ThreadPoolExecutor(options.workers) as threads:
            for results in threads.map(lambda name: campaign({name: numbers[name]}, options.seed, finished), left):
                every += results
                if options.journal is not None:
                    append(options.journal, *map(asdict, results))
    _print({name: [result for result in every if result.kind == name] for name in names}, options.seed)
    sys.exit(any(result.wrong for result in every))


def _print(results: dict[str, list[Result]], seed: int) -> None:
    every = [result for group in results.values() for result in group]
    table = Table(*(Column(name, justify="right" if number else "left") for number, name in enumerate(COLUMNS)))
    for name, group in [*results.items(), ("all", every)]:
        table.add_row(*row(name, group))
    Console(width=WIDTH).print(table)
    for result in every:
        if result.wrong:
            print(f"{command_for(result, seed)}\n    {result.verdict}")


if __name__ == "__main__":
    main()
