"""Table and figure of a sweep: sweep.csv, sweep.json, sweep.png, and the printed lines.

In the figure measured errors are points, predicted ones (Eq. 5) lines. The key with most values is the x axis, numeric
where its values are numbers or quantities. The key with the second most is shown by colour; every combination of the
rest (and of scenes, if there are several) has its own marker and line style. Predictions that the verdict of a run is
against are not drawn, and its measured error is a hollow point. The value at which a curve crosses twice the smallest
predicted error is written beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import log
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.quantity_axis import GREY_LEVELS, QuantityAxis, quantity_axis, spans_decade
from ommatid.figures.saving import COLOURS, MARKERS, SCREEN_PNG, FigureFiles, log_ticks, new_figure, own_style
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import clear_abandoned, make_folder, write_csv
from ommatid.runtime.printable import printable_label

from .sweep_row import NUMBERS, SweepRow, write_rows

TABLE, PICTURE = "sweep.csv", "sweep.png"
NAN = float("nan")
MARGIN = 1.5  # of a logarithmic error axis, beyond the largest and the smallest error
TWICE = 2.0
TINY = 1e-300
MOST_CROSSINGS = 6
WIDEST = 130  # characters of a line of the legend
SCENE = "scene"
LINES = ("-", "--", ":", "-.")
HOLLOW: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 1.5}
WORDS = {
    ("calibration.method", "ideal"): "H as designed, not calibrated",
    ("calibration.method", "points"): "calibrated by point sources",
    ("calibration.method", "transport"): "calibrated by rays",
}

Style = tuple[str, str]  # marker and line style
Combination = tuple[str, ...]  # values of the keys that share a style


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
    present = dict.fromkeys(name for row in rows for name in row.flat())
    fields = SweepRow.model_fields
    columns = [*(name for name in fields if name in present), *(name for name in present if name not in fields)]
    at = columns.index("values")
    return [*columns[:at], *rows[0].values, *columns[at + 1 :]]


@own_style()
def write_figure(path: Path, rows: Sequence[SweepRow], files: FigureFiles = SCREEN_PNG) -> None:
    """Draw the errors of a sweep. Raises MachineError."""
    settings = _settings(rows)
    x_key, colour_key, style_keys = _roles(settings)
    axis = _axis(x_key, settings)
    figure = new_figure(10, 6, layout="constrained")
    panel = figure.subplots()
    shown = list(dict.fromkeys(setting[colour_key] for setting in settings)) if colour_key else [""]
    colours = _colours(colour_key, shown)
    styles: dict[Combination, Style] = {}
    for setting in settings:
        combination = tuple(setting[key] for key in style_keys)
        styles.setdefault(combination, (MARKERS[len(styles) % len(MARKERS)], LINES[len(styles) % len(LINES)]))
    for value, combination in product(colours, styles):
        wanted = {**({colour_key: value} if colour_key else {}), **dict(zip(style_keys, combination, strict=True))}
        curve = [row for row, setting in zip(rows, settings, strict=True) if wanted.items() <= setting.items()]
        _draw_curve(panel, curve, axis, colours[value], styles[combination])
    _label_axes(panel, rows, axis)
    _draw_crossings(panel, rows, axis, colour_key, colours)
    handles = _legend(rows, (colour_key, colours), (style_keys, styles))
    longest = max(len(line) for handle in handles for line in handle.get_label().splitlines())
    figure.legend(handles=handles, loc="outside lower center", ncols=max(1, WIDEST // (longest + 8)), fontsize=9)
    files.replace(figure, path)


def _settings(rows: Sequence[SweepRow]) -> list[dict[str, str]]:
    return [{**row.values, SCENE: row.scene} for row in rows]


def _axis(key: str, settings: Sequence[Mapping[str, str]]) -> QuantityAxis:
    return quantity_axis(key, list(dict.fromkeys(setting[key] for setting in settings)))


def crossings(rows: Sequence[SweepRow]) -> tuple[QuantityAxis, list[Crossing]]:
    """Return the axis along x, and where each curve crosses twice the smallest predicted error of the sweep.

    A curve is the predicted error, or the measured one where a run is not to be trusted. Between two values of the key
    its logarithm is interpolated. Empty where the key has names as values or the smallest error is 0,
    and for curves that stay on one side, or have a single value below.
    """
    settings = _settings(rows)
    key = _roles(settings)[0]
    axis = _axis(key, settings)
    known = [error for error in map(_predicted, rows) if error is not None]
    curves: dict[Combination, list[tuple[float, float]]] = {}
    others = [name for name in settings[0] if name != key and len({setting[name] for setting in settings}) > 1]
    for row, setting in zip(rows, settings, strict=True):
        error = row.mse if row.trusted is False else row.predicted_mse
        if error is not None:
            point = axis.positions[setting[key]], error
            curves.setdefault(tuple(setting[name] for name in others), []).append(point)
    if axis.categories or not known or min(known) == 0:
        return axis, []
    level, found = TWICE * min(known), list[Crossing]()
    for combination, points in curves.items():
        for (left, low), (right, high) in pairwise(sorted(points)):
            if sum(error < level for _, error in points) > 1 and (low < level) != (high < level):
                below, above = (log(max(error, TINY)) for error in (low, high))
                position = axis.between(left, right, (log(level) - below) / (above - below))
                values = dict(zip(others, combination, strict=True))
                found.append(Crossing(values, position, left if low < level else right, level))
    return axis, found


def _roles(settings: Sequence[Mapping[str, str]]) -> tuple[str, str, list[str]]:
    """Keys of the x axis, of the colour ("" if no other key has several values), and of the styles."""
    counts = {key: len({setting[key] for setting in settings}) for key in settings[0]}
    x_key = max((key for key in counts if key != SCENE), key=lambda key: counts[key])
    varied = sorted((key for key in counts if key != x_key and counts[key] > 1), key=lambda key: -counts[key])
    return x_key, (varied or [""])[0], varied[1:]


def _colours(key: str, values: Sequence[str]) -> dict[str, Any]:
    """Colours of a scale for numbers, and colours that differ for names."""
    from matplotlib import colormaps

    if quantity_axis(key, values).categories and len(values) <= len(COLOURS):
        return dict(zip(values, COLOURS, strict=False))
    shades: Any = colormaps["viridis"]
    last = max(len(values) - 1, 1)
    return {value: shades(0.88 * index / last) for index, value in enumerate(values)}


def _draw_curve(panel: Any, rows: Sequence[SweepRow], axis: QuantityAxis, colour: Any, style: Style) -> None:
    """Draw one curve; failed scenes leave a gap."""
    rows = sorted(rows, key=lambda row: axis.positions[row.values[axis.key]])
    x = [axis.positions[row.values[axis.key]] for row in rows]
    predicted = [_or_nan(_predicted(row)) for row in rows]
    marker, line = style
    panel.plot(x, predicted, linestyle=line, color=colour, linewidth=1.6)
    if all(row.mse is None for row in rows):
        panel.plot(x, predicted, ".", color=colour, markersize=7)
    low, high = ([_or_nan(_interval(row)[end]) for row in rows] for end in (0, 1))
    panel.vlines(x, low, high, color=colour, linewidth=5, alpha=0.3)
    for trusted, points in ((True, {"markeredgecolor": "white"}), (False, HOLLOW)):
        measured = [_or_nan(row.mse if (row.trusted is not False) == trusted else None) for row in rows]
        if not trusted and all(row.trusted is not False for row in rows):
            continue
        panel.plot(x, measured, linestyle="none", marker=marker, markersize=6, color=colour, **points)


def _predicted(row: SweepRow) -> float | None:
    """Return the predicted error, None if the verdict is against it."""
    return None if row.trusted is False else row.predicted_mse


def _interval(row: SweepRow) -> tuple[float | None, float | None]:
    return (None, None) if row.trusted is False else (row.expected_low, row.expected_high)


def _or_nan(number: float | None) -> float:
    return NAN if number is None else number


def _label_axes(panel: Any, rows: Sequence[SweepRow], axis: QuantityAxis) -> None:
    failed = sum(row.failed is not None for row in rows)
    scenes = ", ".join(dict.fromkeys(Path(row.scene).stem for row in rows))
    note = f"; {failed} of {len(rows)} failed, see sweep.csv" if failed else ""
    panel.set_title(f"Sweep of {printable_label(scenes)}{note}", fontsize=11)
    panel.set_ylabel(f"mean squared error ({GREY_LEVELS} squared)")
    axis.draw(panel.xaxis)
    numbers = [number for row in rows for number in (row.mse, _predicted(row), *_interval(row))]
    errors = [number for number in numbers if number is not None]
    if spans_decade(errors):
        panel.set_yscale("log")
        panel.set_ylim(min(errors) / MARGIN, max(errors) * MARGIN)
    else:
        panel.set_ylim(0, max(errors) * 1.1 or 1.0)
    panel.grid(visible=True, color="0.9")
    panel.set_axisbelow(True)
    _label_roots(panel)


def _label_roots(panel: Any) -> None:
    """Show the root of the error on the right."""
    right = panel.secondary_yaxis("right", functions=(_root, np.square))
    right.set_ylabel(f"RMS error ({GREY_LEVELS})")
    if panel.get_yscale() == "log":
        log_ticks(right.yaxis)


def _root(squares: FloatArray) -> FloatArray:
    return np.sqrt(np.abs(squares))


def _draw_crossings(
    panel: Any, rows: Sequence[SweepRow], axis: QuantityAxis, colour_key: str, colours: Mapping[str, Any]
) -> None:
    """Mark twice the smallest predicted error, and write at which value of x each curve crosses it."""
    _, found = crossings(rows)
    if not 0 < len(found) <= MOST_CROSSINGS:
        return
    level = found[0].error
    panel.axhline(level, color="0.35", linewidth=1, linestyle=(0, (1, 2)), zorder=1)
    text: dict[str, Any] = {"fontsize": 8, "color": "0.3", "va": "bottom"}
    panel.text(0.008, level, "twice the smallest error", transform=panel.get_yaxis_transform(), **text)
    for crossing in found:
        colour = colours.get(crossing.values.get(colour_key, ""), COLOURS[0])
        panel.plot([crossing.position], [level], "x", color=colour, markersize=8, markeredgewidth=2, zorder=6)
        side = (
            {"xytext": (7, 5), "va": "bottom"}
            if crossing.good > crossing.position
            else {"xytext": (7, -5), "va": "top"}
        )
        place: dict[str, Any] = {**side, "textcoords": "offset points", "fontsize": 9}
        panel.annotate(axis.limit(crossing.position, crossing.good), (crossing.position, level), color=colour, **place)


def _legend(
    rows: Sequence[SweepRow],
    coloured: tuple[str, Mapping[str, Any]],
    styled: tuple[list[str], Mapping[Combination, Style]],
) -> list[Any]:
    """Handles: predicted, measured and interval; then each colour's value; then each style's combination."""
    from matplotlib.lines import Line2D

    handle: Any = Line2D
    grey: dict[str, Any] = {"color": "0.3"}
    handles: list[Any] = [handle([], [], **grey, label="predicted (Eq. 5)")]
    if any(row.mse is not None for row in rows):
        handles.append(handle([], [], **grey, linestyle="none", marker="o", label="measured"))
    if any(row.mse is not None and row.trusted is False for row in rows):
        words = "measured, not to be trusted"
        handles.append(handle([], [], **grey, linestyle="none", marker="o", **HOLLOW, label=words))
    if any(row.expected_low is not None for row in rows):
        handles.append(handle([], [], **grey, linewidth=3, alpha=0.3, label="99 % for this picture"))
    key, colours = coloured
    if key:
        handles += [handle([], [], color=colour, linewidth=4, label=_label(key, v)) for v, colour in colours.items()]
    keys, styles = styled
    if keys:
        handles += [
            handle([], [], **grey, marker=marker, linestyle=line, label="\n".join(map(_label, keys, values)))
            for values, (marker, line) in styles.items()
        ]
    return handles


def _label(key: str, value: str) -> str:
    if key == SCENE:
        return printable_label(Path(value).stem)
    words = WORDS.get((key, value.strip("\"'")))
    return printable_label(f"{key} = {value}") + (f" ({words})" if words else "")
