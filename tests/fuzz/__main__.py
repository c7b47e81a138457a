"""The long campaign: `python -m tests.fuzz --inputs 10000 --seed 1`, and one input of it again."""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..conftest import TINY, shell
from .campaign import ANOTHER, REFUSED, UNCHANGED, Result, again, campaign, damaged, prepare
from .kinds import KINDS, SCENE

COLUMNS = ("kind of input", "damaged", REFUSED, UNCHANGED, ANOTHER, "wrong", "seconds", "slowest")


def finished_run(folder: Path) -> Path:
    """The folder of a finished run of the tiny scene."""
    (folder / SCENE).write_text(TINY, encoding="utf-8")
    ended = shell("run", SCENE, "-o", "out", cwd=folder)
    if ended.code:
        raise SystemExit(ended.err)
    return folder / "out" / Path(SCENE).stem


def row(name: str, results: list[Result]) -> tuple[str, ...]:
    """What became of a kind, in the table's columns."""
    counts = [sum(result.verdict == verdict for result in results) for verdict in (REFUSED, UNCHANGED, ANOTHER)]
    wrong = sum(result.wrong for result in results)
    seconds = [result.seconds for result in results]
    times = f"{sum(seconds):.1f}", f"{max(seconds, default=0.0):.2f}"
    return name, *map(str, (len(results), *counts, wrong)), *times


def main() -> None:
    """Run the campaign over all kinds, or over one."""
    options = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    options.add_argument("--inputs", type=int, default=10000, help="of all kinds together")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--kind", choices=sorted(KINDS), help="this kind alone")
    options.add_argument("--only", type=int, metavar="NUMBER", help="this input of --kind again")
    options.add_argument("--keep", type=Path, metavar="FILE", help="where --only puts the damaged input")
    options.add_argument("--workers", type=int, default=2)
    told = options.parse_args()
    names = [told.kind] if told.kind else list(KINDS)
    with tempfile.TemporaryDirectory() as folder:
        finished = finished_run(Path(folder))
        if told.only is not None:
            _again(names[0], told.seed, told.only, finished, told.keep)
            return
        each = -(-told.inputs // len(names))
        with ThreadPoolExecutor(told.workers) as threads:
            found = list(threads.map(lambda name: campaign({name: range(each)}, told.seed, finished), names))
    _print(dict(zip(names, found, strict=True)), told.seed)
    sys.exit(any(result.wrong for results in found for result in results))


def _again(name: str, seed: int, number: int, finished: Path, keep: Path | None) -> None:
    if keep is not None:
        kind = KINDS[name]
        with tempfile.TemporaryDirectory() as folder:
            prepare(Path(folder), finished)
            keep.write_bytes(damaged(kind, seed, number, kind.originals(Path(folder)))[1])
    print(*campaign({name: [number]}, seed, finished), sep="\n")


def _print(found: dict[str, list[Result]], seed: int) -> None:
    rows = [COLUMNS, *(row(name, results) for name, results in found.items())]
    rows.append(row("all", [result for results in found.values() for result in results]))
    widths = [max(len(cells[column]) for cells in rows) for column in range(len(COLUMNS))]
    for cells in rows:
        print(
            "  ".join(
                cell.rjust(width) if column else cell.ljust(width)
                for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
            )
        )
    for results in found.values():
        for result in results:
            if result.wrong:
                print(f"{again(result, seed)}\n    {result.verdict}")


if __name__ == "__main__":
    main()
