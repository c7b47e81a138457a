"""How often error bars are correct: `python -m tests.benchmarks coverage`.

Every cell is run with many seeds, as `ommatid run` does it. The journal keeps the content of run.json, so that a second
start runs what is missing.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Sequence
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import stats

from ommatid.interface import calibrate, reconstruct, render, target_image
from ommatid.reconstruct.expected_error import COVERAGE
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.runtime.study import Row, entries, study

from .coverage_cells import CELLS, Cell
from .rows import markdown, say_failed

OUTSIDE = COVERAGE[0] + 1 - COVERAGE[1]  # share of errors outside correct intervals
CHANCE = 2e-3  # that a cell of correct error bars has more misses than are allowed
FEW = "†"
JOURNAL = "coverage.jsonl"
COLUMNS = (
    "cell",
    "runs",
    "error / Eq. 5",
    "error / expected",
    "inside",
    "chi-squared / expected",
    "z",
    "red",
    "false alarms",
    "silent misses",
)


def measured_run(cell: Cell, number: int) -> RunReport:
    """Render, calibrate and reconstruct run `number` of a cell, whose definition is the report's fingerprint."""
    with TemporaryDirectory(prefix="ommatid-") as folder:
        scene = cell.prepared(number, Path(folder))
        stack = render(scene)
        result = reconstruct(stack, calibrate(scene, stack), target_image(scene))
    return result.summary.with_changes(fingerprint=cell.definition)


def results(folder: Path, cell: Cell) -> dict[int, RunReport]:
    """Read the results of a cell by number; those of another definition of the cell do not count."""
    rows = [entry["row"] for entry in entries(folder / JOURNAL)]
    own = [row for row in rows if (row["cell"], row["definition"]) == (cell.name, cell.definition)]
    own.sort(key=lambda row: row["number"])
    return {row["number"]: RunReport.model_validate(row["report"]) for row in own}


def complete(cells: Sequence[Cell], folder: Path, seeds: int | None) -> None:
    """Run what is missing of the first `seeds` runs of cells; an error ends that run alone."""
    by_name = {cell.name: cell for cell in cells}
    listed = [
        {"cell": cell.name, "definition": definition, "number": number}
        for cell in cells
        for definition in (cell.definition,)
        for number in range(seeds or cell.seeds)
    ]

    def measure(row: Row) -> Row:
        report = measured_run(by_name[row["cell"]], row["number"])
        print(f"{row['cell']} {row['number']}: {_line(report)}", file=sys.stderr, flush=True)
        return {"report": report.plain()}

    study(folder / JOURNAL, listed, measure, say_failed, Exception)


def is_inside(report: RunReport) -> bool | None:
    """Return whether the interval contains the measured error, None if there is no interval."""
    interval, mse = report.error.expected_given_truth, report.error.mse
    return None if interval is None or mse is None else interval.low <= mse <= interval.high


def is_red(report: RunReport) -> bool:
    """Return whether the verdict is not to be trusted."""
    return not report.verdict.trusted


def allowed_misses(runs: int) -> int:
    """Return the largest number of errors outside correct intervals that chance explains: 2 of 20, 3 of 40."""
    return int(stats.binom.isf(CHANCE, runs, OUTSIDE)) if runs else 0


def holds(reports: Sequence[RunReport]) -> bool:
    """Return False if more runs are outside than correct intervals would leave by chance."""
    inside = [is_inside(report) for report in reports]
    return inside.count(False) <= allowed_misses(len(inside) - inside.count(None))


def mean(values: Iterable[float]) -> tuple[float, float]:
    """Return a mean over runs and its standard error; NaN without runs, the error also for one."""
    sample = np.array(list(values), dtype=np.float64)
    error = float(sample.std(ddof=1) / sample.size**0.5) if sample.size > 1 else nan
    return float(sample.mean()) if sample.size else nan, error


def ratios(reports: Sequence[RunReport]) -> tuple[list[float], list[float]]:
    """Return measured errors over those of Eq. 5, and over those expected for the image."""
    by_equation, expected = list[float](), list[float]()
    for error in (report.error for report in reports):
        if error.mse is not None and error.predicted_mse:
            by_equation.append(error.mse / error.predicted_mse)
        if error.mse is not None and error.expected_given_truth is not None and error.expected_given_truth.mse:
            expected.append(error.mse / error.expected_given_truth.mse)
    return by_equation, expected


def row(name: str, reports: Sequence[RunReport]) -> tuple[str, ...]:
    """Return a cell's row of the table."""
    inside, red = [is_inside(report) for report in reports], [is_red(report) for report in reports]
    held = f"{inside.count(True)} of {len(inside) - inside.count(None)}"
    chi = [each for each in (report.diagnostics.chi_squared for report in reports) if each is not None]
    chi = [each for each in chi if each.expected and each.deviation]
    return (
        name,
        str(len(reports)),
        *(_with_error(values) for values in ratios(reports)),
        held if holds(reports) else f"**{held}**",
        _with_error([each.chi_squared / each.expected for each in chi]),
        f"{mean((each.chi_squared - each.expected) / each.deviation for each in chi)[0]:+.2f}",
        str(sum(red)),
        str(sum(alarm and place is True for alarm, place in zip(red, inside, strict=True))),
        str(sum(not alarm and place is False for alarm, place in zip(red, inside, strict=True))),
    )


def table(cells: Sequence[Cell], folder: Path) -> str:
    """Return the table of the cells that have results in the folder, in Markdown, and a sentence on those that fail."""
    known = [(_marked(cell), list(results(folder, cell).values())) for cell in cells]
    known = [(name, reports) for name, reports in known if reports]
    failing = ", ".join(name for name, reports in known if not holds(reports))
    text = markdown(COLUMNS, (row(name, reports) for name, reports in known))
    few = f"{FEW} fewer samples than the scene asks for."
    return f"{text}\n\nCells with too many errors outside: {failing or 'none'}. {few}"


def command(arguments: Sequence[str]) -> None:
    """Run the benchmark with the options of its command line."""
    options = _options(arguments)
    by_name = {cell.name: cell for cell in CELLS}
    names = [name.strip() for name in options.cells.split(",") if name.strip()] or list(by_name)
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise SystemExit(f"{unknown[0]!r} is not a cell; see python -m tests.benchmarks coverage --list")
    cells = [by_name[name] for name in names]
    if options.list:
        print(*(_described(cell, options.seeds or cell.seeds) for cell in cells), sep="\n")
        hours = sum(cell.seconds * (options.seeds or cell.seeds) for cell in cells) / 3600
        print(f"{len(cells)} cells, some {hours:.1f} hours on two cores")
        return
    if not options.table:
        complete(cells, options.out, options.seeds)
    print(table(cells, options.out))


def _options(arguments: Sequence[str]) -> Namespace:
    parser = ArgumentParser("python -m tests.benchmarks coverage", description="How often error bars are correct.")
    parser.add_argument("-o", "--out", type=Path, default=Path("coverage"), help="folder of the results; default: here")
    parser.add_argument("--cells", default="", metavar="NAME,...", help="cells to run; default: all")
    parser.add_argument("--seeds", type=int, metavar="N", help="runs per cell; default: 20, in some cells 40")
    parser.add_argument("--list", action="store_true", help="list the cells and run nothing")
    parser.add_argument("--table", action="store_true", help="print the table of the results in the folder, no more")
    return parser.parse_args(arguments)


def _described(cell: Cell, seeds: int) -> str:
    lenses = f" --lens {','.join(cell.lenses)}" if cell.lenses else ""
    changes = "".join(f" --set '{change}'" for change in cell.changes)
    image = ", images drawn from the prior" if cell.drawn else ""
    return f"{cell.name}: {seeds} runs of {cell.seconds:g} s{image}: {cell.scene}{lenses}{changes}"


def _line(report: RunReport) -> str:
    place = {True: "inside", False: "OUTSIDE", None: "no interval"}[is_inside(report)]
    verdict = "red" if is_red(report) else "trusted"
    of_equation = "".join(f"{ratio:.3f} of Eq. 5, " for ratio in ratios([report])[0])
    return f"error {report.error.mse:.4g}, {of_equation}{place}, {verdict}, {report.seconds:.1f} s"


def _with_error(values: Sequence[float]) -> str:
    value, error = mean(values)
    return "-" if np.isnan(value) else f"{value:.3f}{'' if np.isnan(error) else f' ± {error:.3f}'}"


def _marked(cell: Cell) -> str:
    """Return the name of a cell, marked if the samples of its H are fewer than those of the scene."""
    return f"{cell.name} {FEW}" if cell.has_few_samples else cell.name
