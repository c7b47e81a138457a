"""Table of a sweep, one row per scene: sweep.csv, sweep.json, the figure sweep.png, and the printed lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ommatid.figures.saving import SCREEN_PNG, FigureFiles
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.runtime.files import clear_abandoned, make_folder, write_csv

from .sweep_figure import crossings, write_figure
from .sweep_row import NUMBERS, SweepRow, write_rows

TABLE, PICTURE = "sweep.csv", "sweep.png"


def write_sweep(folder: Path, rows: Sequence[SweepRow], figures: FigureFiles = SCREEN_PNG) -> None:
    """Write sweep.csv, sweep.json and, if there are errors to show, sweep.png. Raises MachineError."""
    make_folder(folder)
    clear_abandoned(folder)
    if any(row.predicted_mse is not None for row in rows):
        write_figure(folder / PICTURE, rows, figures)
    columns = _columns(rows)
    flat = [{**row.flat(), **row.values} for row in rows]
    write_csv(folder / TABLE, columns, ([row.get(name) for name in columns] for row in flat))
    write_rows(folder / NUMBERS, rows)


def lines(rows: Sequence[SweepRow]) -> list[tuple[str, str]]:
    """Lines of the printed table: the values of a scene, and its errors."""
    several = len({row.scene for row in rows}) > 1
    printed: list[tuple[str, str]] = []
    for row in rows:
        label = [Path(row.scene).stem] if several else []
        label += [f"{key} = {value}" for key, value in row.values.items()]
        errors = {"mse": row.mse, "predicted mse": row.predicted_mse}
        result = [f"{name} {error_words(error)}" for name, error in errors.items() if error is not None]
        result += ["not to be trusted"] if row.trusted is False else []
        result += [] if row.null_space is None else [f"null space {row.null_space}"]
        printed.append((", ".join(label), row.failed or ", ".join(result) or "done"))
    return [*printed, *_crossing_lines(rows)]


def _crossing_lines(rows: Sequence[SweepRow]) -> list[tuple[str, str]]:
    """Lines that say from or up to which value of the key along x each curve is below twice the smallest error."""
    axis, found = crossings(rows)
    printed: list[tuple[str, str]] = []
    for crossing in found:
        others = "".join(f", {key} = {value}" for key, value in crossing.values.items())
        words = f"{axis.key} {axis.limit(crossing.position, crossing.good)}{others}"
        printed.append((f"below twice the smallest error, mse {crossing.error:.4g}", words))
    return printed


def _columns(rows: Sequence[SweepRow]) -> list[str]:
    """Columns of sweep.csv: scene, folder, the swept keys, then what at least one row has, in the fields' order."""
    present = list(dict.fromkeys(name for row in rows for name in row.flat()))
    columns = [name for field in SweepRow.model_fields for name in present if name.partition(".")[0] == field]
    at = columns.index("values")
    return [*columns[:at], *rows[0].values, *columns[at + 1 :]]
