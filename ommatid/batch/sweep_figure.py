"""Figure of a sweep's errors: measured ones as points, predicted ones (Eq. 5) as lines.

The key with most values is the x axis. The key with the second most is shown by colour; every combination of the rest
(and of scenes, if there are several) has its own marker and line style.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from ommatid.runtime.files import write_whole

from .sweep_row import SweepRow

NAN = float("nan")
DECADES = 30.0  # ratio of the largest to the smallest value from which an axis is logarithmic
MOST_TICKS = 12
MARGIN = 1.5  # of a logarithmic error axis, beyond the largest and the smallest error
OFFSET = 18.0  # 1/72 inch, between the points of the first and of the last curve
SCENE = "scene"
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES = ("-", "--", ":", "-.")
UNITS = {"variance": "squared units of f", "noise_variance": "squared units of f", "samples": "per sensor pixel"}
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Zµ]*)")

Style = tuple[str, str]  # marker and line style
Combination = tuple[str, ...]  # values of the keys that share a style


@dataclass(frozen=True)
class Scale:
    """The x axis of a swept key: the position of each value, numeric or one step per category."""

    key: str
    positions: dict[str, float]
    unit: str
    logarithmic: bool
    categories: bool


def scale(key: str, values: Sequence[str]) -> Scale:
    """Axis for the values of a key: numbers of one unit are numeric, ratios and everything else are categories."""
    matches = [match for value in values if (match := _NUMBER.fullmatch(value.strip("\"'"))) is not None]
    units = {match[2] for match in matches}
    if len(matches) < len(values) or len(units) != 1:
        return Scale(key, {value: float(index) for index, value in enumerate(values)}, "", False, True)
    numbers = [float(match[1]) for match in matches]
    unit = units.pop() or UNITS.get(key.rsplit(".", 1)[-1], "")
    return Scale(key, dict(zip(values, numbers, strict=True)), unit, _spans_decades(numbers), False)


def write_figure(path: Path, rows: Sequence[SweepRow]) -> None:
    """Draw the errors of a sweep. Raises MachineError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    settings = [{**row.values, SCENE: row.scene} for row in rows]
    x_key, colour_key, style_keys = _roles(settings)
    axis = scale(x_key, list(dict.fromkeys(setting[x_key] for setting in settings)))
    figure: Any = Figure(figsize=(10, 6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    colours = _colours(list(dict.fromkeys(setting[colour_key] for setting in settings)) if colour_key else [""])
    styles: dict[Combination, Style] = {}
    for setting in settings:
        combination = tuple(setting[key] for key in style_keys)
        styles.setdefault(combination, (MARKERS[len(styles) % len(MARKERS)], LINES[len(styles) % len(LINES)]))
    last = len(colours) * len(styles) - 1
    for index, (value, combination) in enumerate(product(colours, styles)):
        curve = [
            row
            for row, setting in zip(rows, settings, strict=True)
            if (not colour_key or setting[colour_key] == value)
            and tuple(setting[key] for key in style_keys) == combination
        ]
        offset = (index - last / 2) / max(last, 1) * OFFSET
        _draw_curve(panel, curve, axis, colours[value], styles[combination], offset)
    _label_axes(panel, rows, axis)
    handles = _legend(rows, (colour_key, colours), (style_keys, styles))
    figure.legend(handles=handles, loc="outside right upper", fontsize=9)
    write_whole(path, lambda temporary: figure.savefig(temporary, format="png"))


def _roles(settings: Sequence[Mapping[str, str]]) -> tuple[str, str, list[str]]:
    """Keys of the x axis, of the colour ("" if no other key has several values), and of the styles."""
    counts = {key: len({setting[key] for setting in settings}) for key in settings[0]}
    x_key = max((key for key in counts if key != SCENE), key=lambda key: counts[key])
    varied = sorted((key for key in counts if key != x_key and counts[key] > 1), key=lambda key: -counts[key])
    return x_key, (varied or [""])[0], varied[1:]


def _colours(values: Sequence[str]) -> dict[str, Any]:
    from matplotlib import colormaps

    shades: Any = colormaps["viridis"]
    last = max(len(values) - 1, 1)
    return {value: shades(0.88 * index / last) for index, value in enumerate(values)}


def _draw_curve(panel: Any, rows: Sequence[SweepRow], axis: Scale, colour: Any, style: Style, offset: float) -> None:
    """Draw one curve; failed scenes leave a gap.

    offset : of the points along x, 1/72 inch, so that the points of different curves do not hide one another
    """
    from matplotlib.transforms import ScaledTranslation

    inch: Any = panel.figure.dpi_scale_trans
    shifted: Any = panel.transData + ScaledTranslation(offset / 72, 0, inch)
    rows = sorted(rows, key=lambda row: axis.positions[row.values[axis.key]])
    x = [axis.positions[row.values[axis.key]] for row in rows]
    predicted = [_or_nan(row.predicted_mse) for row in rows]
    measured = [_or_nan(row.mse) for row in rows]
    marker, line = style
    panel.plot(x, predicted, linestyle=line, color=colour, linewidth=1.6)
    if len(x) == 1 or all(row.mse is None for row in rows):
        panel.plot(x, predicted, "_", color=colour, markersize=14)
    low, high = ([_or_nan(_interval(row)[end]) for row in rows] for end in (0, 1))
    panel.vlines(x, low, high, color=colour, linewidth=3, alpha=0.3, transform=shifted)
    points = {"marker": marker, "markersize": 6, "markeredgecolor": "white", "transform": shifted}
    panel.plot(x, measured, linestyle="none", color=colour, **points)


def _interval(row: SweepRow) -> tuple[float | None, float | None]:
    return row.expected_low, row.expected_high


def _or_nan(number: float | None) -> float:
    return NAN if number is None else number


def _label_axes(panel: Any, rows: Sequence[SweepRow], axis: Scale) -> None:
    failed = sum(row.failed is not None for row in rows)
    scenes = ", ".join(dict.fromkeys(Path(row.scene).stem for row in rows))
    note = f"; {failed} of {len(rows)} failed, see sweep.csv" if failed else ""
    panel.set_title(f"Sweep of {scenes}{note}", fontsize=11)
    panel.set_xlabel(f"{axis.key} ({axis.unit})" if axis.unit else axis.key)
    panel.set_ylabel("mean squared error (squared units of f)")
    if axis.logarithmic:
        panel.set_xscale("log")
    if axis.categories or len(axis.positions) <= MOST_TICKS:
        panel.set_xticks(list(axis.positions.values()), [value.strip("\"'") for value in axis.positions])
        panel.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    if len(axis.positions) > MOST_TICKS // 2:
        panel.tick_params(axis="x", labelrotation=45)
    numbers = [number for row in rows for number in (row.mse, row.predicted_mse, *_interval(row))]
    errors = [number for number in numbers if number is not None]
    if _spans_decades(errors):
        panel.set_yscale("log")
        panel.set_ylim(min(errors) / MARGIN, max(errors) * MARGIN)
    else:
        panel.set_ylim(0, max(errors) * 1.1 or 1.0)
    panel.grid(visible=True, color="0.9")
    panel.set_axisbelow(True)


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
    return Path(value).stem if key == SCENE else f"{key} = {value}"


def _spans_decades(values: Sequence[float]) -> bool:
    return bool(values) and min(values) > 0 and max(values) / min(values) >= DECADES
