"""Table and figure of a sweep: sweep.csv, sweep.json, sweep.png, and the printed lines.

In the figure measured errors are points, predicted ones (Eq. 5) lines. The key with most values is the x axis, numeric
where its values are numbers or quantities. The key with the second most is shown by colour; every combination of the
rest (and of scenes, if there are several) has its own marker and line style. Predictions that the verdict of a run is
against are not drawn, and its measured error is a hollow point. The value at which a curve crosses twice the smallest
predicted error is written beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log, nan
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.curves import LINES, Style, cycled, draw_curve, label, legend
from ommatid.figures.quantity_axis import GREY_LEVELS, QuantityAxis, quantity_axis, spans_decade
from ommatid.figures.saving import COLOURS, MARKERS, SCREEN_PNG, FigureFiles, log_ticks, new_figure, own_style
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.runtime import study
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import clear_abandoned, make_folder
from ommatid.runtime.printable import printable_label
from ommatid.runtime.study import Row

from .sweep_row import NUMBERS, SweepRow, write_rows

TABLE, PICTURE = "sweep.csv", "sweep.png"
MARGIN = 1.5  # of a logarithmic error axis, beyond the largest and the smallest error
TWICE = 2.0
TINY = 1e-300
MOST_CROSSINGS = 6
WIDEST = 130  # characters of a line of the legend
SCENE = "scene"
GREY: Style = {"color": "0.3"}
POINT: Style = {"linestyle": "none", "markersize": 6}
HOLLOW: Style = {**POINT, "markerfacecolor": "white", "markeredgewidth": 1.5}
WORDS = {
    ("calibration.method", "ideal"): "H as designed, not calibrated",
    ("calibration.method", "points"): "calibrated by point sources",
    ("calibration.method", "transport"): "calibrated by rays",
}


@dataclass(frozen=True)
class Crossing:
    """Where a curve crosses twice the smallest predicted error of the sweep.

    values : of the keys other than the one along x;  position : along x;  error : the level that is crossed
    good : the next position with a smaller error
    """

    values: dict[str, str]
    position: float
    good: float
    error: float


@dataclass(frozen=True)
class Curves:
    """The rows of a sweep by the values of all keys but the one along x.

    colour, styles : keys that are shown by colour, "" for none, and by markers and lines
    rows : of each curve, by the values of these keys, the one of `colour` first
    """

    axis: QuantityAxis
    colour: str
    styles: list[str]
    rows: dict[tuple[str, ...], list[SweepRow]]

    @classmethod
    def of(cls, rows: Sequence[SweepRow]) -> Curves:
        """Take the key with most values along x, and the one with the second most as colour."""
        settings = [{**row.values, SCENE: row.scene} for row in rows]
        values = {key: list(dict.fromkeys(setting[key] for setting in settings)) for key in settings[0]}
        x = max((key for key in values if key != SCENE), key=lambda key: len(values[key]))
        others = sorted((key for key in values if key != x and len(values[key]) > 1), key=lambda key: -len(values[key]))
        curves: dict[tuple[str, ...], list[SweepRow]] = {}
        for row, setting in zip(rows, settings, strict=True):
            curves.setdefault(tuple(setting[key] for key in others), []).append(row)
        return cls(quantity_axis(x, values[x]), (others or [""])[0], others[1:], curves)

    def position(self, row: SweepRow) -> float:
        """Return the position of a row along x."""
        return self.axis.positions[row.values[self.axis.key]]

    @property
    def looks(self) -> dict[tuple[str, ...], Style]:
        """Colour, marker and line of each curve: colours of a scale for numbers, and unlike ones for names."""
        from matplotlib import colormaps

        values = list(dict.fromkeys((values or ("",))[0] for values in self.rows))
        names = quantity_axis(self.colour, values).categories and len(values) <= len(COLOURS)
        shades: Any = colormaps["viridis"]
        last = max(len(values) - 1, 1)
        combinations = list(dict.fromkeys(values[1:] for values in self.rows))
        looks: dict[tuple[str, ...], Style] = {}
        for key in self.rows:
            number, combination = values.index((key or ("",))[0]), combinations.index(key[1:])
            colour = COLOURS[number] if names else shades(0.88 * number / last)
            style = {"marker": cycled(combination, MARKERS), "linestyle": cycled(combination, LINES)}
            looks[key] = {"color": colour, **style}
        return looks


def write_sweep(folder: Path, rows: Sequence[SweepRow], figures: FigureFiles = SCREEN_PNG) -> None:
    """Write sweep.csv, sweep.json and, if there are errors to show, sweep.png. Raises MachineError."""
    make_folder(folder)
    clear_abandoned(folder)
    if any(row.predicted_mse is not None for row in rows):
        write_figure(folder / PICTURE, rows, figures)
    flat = [{**row.flat(), **row.values} for row in rows]
    for row in flat:
        del row["values"]
    study.write_rows(folder / TABLE, flat, [SCENE, "folder", *rows[0].values, *SweepRow.model_fields])
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


@own_style()
def write_figure(path: Path, rows: Sequence[SweepRow], files: FigureFiles = SCREEN_PNG) -> None:
    """Draw the errors of a sweep. Raises MachineError."""
    curves = Curves.of(rows)
    figure = new_figure(10, 6, layout="constrained")
    panel, looks = figure.subplots(), curves.looks
    shown = {
        key: [_numbers(row, curves.position(row)) for row in sorted(own, key=curves.position)]
        for key, own in curves.rows.items()
    }
    _label_axes(panel, rows, curves.axis, [row for own in shown.values() for row in own])
    for key, own in shown.items():
        _draw_curve(panel, own, **looks[key])
    _draw_crossings(panel, rows, curves)
    entries = _legend(rows, curves)
    longest = max(len(line) for _, words in entries for line in words.splitlines())
    legend(figure, entries, loc="outside lower center", ncols=max(1, WIDEST // (longest + 8)))
    files.replace(figure, path)


def _numbers(row: SweepRow, position: float) -> Row:
    """Return what is drawn of a row; NaN, a gap in a line, where its command failed or the verdict is against it."""
    trusted = row.trusted is not False
    numbers = {"measured": row.mse if trusted else None, "doubted": None if trusted else row.mse}
    if trusted:
        numbers |= {"predicted": row.predicted_mse, "low": row.expected_low, "high": row.expected_high}
    names = ("predicted", "low", "high", "measured", "doubted")
    return {"x": position, **{name: nan if numbers.get(name) is None else numbers[name] for name in names}}


def crossings(rows: Sequence[SweepRow]) -> tuple[QuantityAxis, list[Crossing]]:
    """Return the axis along x, and where each curve crosses twice the smallest predicted error of the sweep.

    A curve is the predicted error, or the measured one where a run is not to be trusted. Between two values of the key
    its logarithm is interpolated. Empty where the key has names as values or the smallest error is 0,
    and for curves that stay on one side, or have a single value below.
    """
    curves, found = Curves.of(rows), list[Crossing]()
    known = [row.predicted_mse for row in rows if row.predicted_mse is not None and row.trusted is not False]
    if curves.axis.categories or not known or min(known) == 0:
        return curves.axis, []
    level, keys = TWICE * min(known), [curves.colour, *curves.styles]
    for key, own in curves.rows.items():
        errors = [(curves.position(row), row.mse if row.trusted is False else row.predicted_mse) for row in own]
        points = sorted((position, error) for position, error in errors if error is not None)
        if sum(error < level for _, error in points) < 2:
            continue
        for (left, low), (right, high) in pairwise(points):
            if (low < level) != (high < level):
                below, above = (log(max(error, TINY)) for error in (low, high))
                position = curves.axis.between(left, right, (log(level) - below) / (above - below))
                values = dict(zip(keys, key, strict=False))
                found.append(Crossing(values, position, left if low < level else right, level))
    return curves.axis, found


def _draw_curve(panel: Any, rows: Sequence[Row], *, color: Any, marker: str, linestyle: str) -> None:
    """Draw one curve."""
    draw_curve(panel, rows, "x", "predicted", linestyle=linestyle, color=color, linewidth=1.6)
    if not any(row[name] > 0 for row in rows for name in ("measured", "doubted")):
        draw_curve(panel, rows, "x", "predicted", linestyle="none", marker=".", color=color, markersize=7)
    x, low, high = ([row[name] for row in rows] for name in ("x", "low", "high"))
    panel.vlines(x, low, high, color=color, linewidth=5, alpha=0.3)
    for name, style in (("measured", {**POINT, "markeredgecolor": "white"}), ("doubted", HOLLOW)):
        if not np.isnan([row[name] for row in rows]).all():
            draw_curve(panel, rows, "x", name, marker=marker, color=color, **style)


def _label_axes(panel: Any, rows: Sequence[SweepRow], axis: QuantityAxis, shown: Sequence[Row]) -> None:
    """Name the axes, with the root of the error on the right."""
    failed = sum(row.failed is not None for row in rows)
    scenes = ", ".join(dict.fromkeys(Path(row.scene).stem for row in rows))
    note = f"; {failed} of {len(rows)} failed, see sweep.csv" if failed else ""
    label(panel, f"Sweep of {printable_label(scenes)}{note}", "", f"mean squared error ({GREY_LEVELS} squared)")
    axis.draw(panel.xaxis)
    numbers = [value for row in shown for name, value in row.items() if name != "x" and not np.isnan(value)]
    if spans_decade(numbers):
        panel.set_yscale("log")
        panel.set_ylim(min(numbers) / MARGIN, max(numbers) * MARGIN)
    else:
        panel.set_ylim(0, max(numbers) * 1.1 or 1.0)
    right = panel.secondary_yaxis("right", functions=(_root, np.square))
    right.set_ylabel(f"RMS error ({GREY_LEVELS})")
    if panel.get_yscale() == "log":
        log_ticks(right.yaxis)


def _root(squares: FloatArray) -> FloatArray:
    return np.sqrt(np.abs(squares))


def _draw_crossings(panel: Any, rows: Sequence[SweepRow], curves: Curves) -> None:
    """Mark twice the smallest predicted error, and write at which value of x each curve crosses it."""
    axis, found = crossings(rows)
    if not 0 < len(found) <= MOST_CROSSINGS:
        return
    level, looks = found[0].error, curves.looks
    panel.axhline(level, color="0.35", linewidth=1, linestyle=(0, (1, 2)), zorder=1)
    text: Style = {"fontsize": 8, "color": "0.3", "va": "bottom"}
    panel.text(0.008, level, "twice the smallest error", transform=panel.get_yaxis_transform(), **text)
    for crossing in found:
        colour = looks[tuple(crossing.values.values())]["color"]
        panel.plot([crossing.position], [level], "x", color=colour, markersize=8, markeredgewidth=2, zorder=6)
        rises = crossing.good > crossing.position
        place: Style = {"xytext": (7, 5 if rises else -5), "va": "bottom" if rises else "top", "fontsize": 9}
        words = axis.limit(crossing.position, crossing.good)
        panel.annotate(words, (crossing.position, level), textcoords="offset points", color=colour, **place)


def _legend(rows: Sequence[SweepRow], curves: Curves) -> list[tuple[Style, str]]:
    """Entries: predicted, measured and interval; then each colour's value; then each style's combination."""
    entries: list[tuple[Style, str]] = [(GREY, "predicted (Eq. 5)")]
    if any(row.mse is not None for row in rows):
        entries.append(({**GREY, **POINT, "marker": "o"}, "measured"))
    if any(row.mse is not None and row.trusted is False for row in rows):
        entries.append(({**GREY, **HOLLOW, "marker": "o"}, "measured, not to be trusted"))
    if any(row.expected_low is not None for row in rows):
        entries.append(({**GREY, "linewidth": 3, "alpha": 0.3}, "99 % for this picture"))
    looks, words = curves.looks, dict[str, Style]()
    for key, look in looks.items() if curves.colour else ():
        words.setdefault(_label(curves.colour, key[0]), {"color": look["color"], "linewidth": 4})
    for key, look in looks.items() if curves.styles else ():
        combination = "\n".join(_label(name, value) for name, value in zip(curves.styles, key[1:], strict=True))
        words.setdefault(combination, {**look, **GREY})
    return entries + [(style, name) for name, style in words.items()]


def _label(key: str, value: str) -> str:
    if key == SCENE:
        return printable_label(Path(value).stem)
    words = WORDS.get((key, value.strip("\"'")))
    return printable_label(f"{key} = {value}") + (f" ({words})" if words else "")
