"""The errors of a sweep as one plot: measured ones as points, predicted ones (Eq. 5) as lines.

Along x goes the key with most values. The next key has a colour a value; every combination of the rest, and of scenes
where there are several, a marker and a kind of line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from ommatid.runtime.files import write_whole

Row = Mapping[str, Any]

DECADES = 30.0  # ratio of the largest to the smallest, from which on an axis is logarithmic
MOST_TICKS = 12
MARGIN = 1.5  # of a logarithmic axis of errors, beyond the largest and the least
ASIDE = 18.0  # 1/72 inch, from the first curve's points to the last one's
SCENE = "scene"
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES = ("-", "--", ":", "-.")
UNITS = {"variance": "squared units of f", "noise_variance": "squared units of f", "samples": "a sensor pixel"}
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Zµ]*)")


@dataclass(frozen=True)
class Scale:
    """Where the values of a key stand on the x axis: numbers, or places of categories where they are none."""

    key: str
    places: dict[str, float]
    unit: str
    logarithmic: bool
    categories: bool


def scale(key: str, values: Sequence[str]) -> Scale:
    """Numbers of one unit are numbers, and logarithmic if they span decades; ratios and all else are categories."""
    found = [_NUMBER.fullmatch(value.strip("\"'")) for value in values]
    read = [match for match in found if match is not None]
    units = {match[2] for match in read}
    if len(read) < len(values) or len(units) != 1:
        return Scale(key, {value: float(place) for place, value in enumerate(values)}, "", False, True)
    numbers = [float(match[1]) for match in read]
    unit = units.pop() or UNITS.get(key.rsplit(".", 1)[-1], "")
    return Scale(key, dict(zip(values, numbers, strict=True)), unit, _spans(numbers), False)


def write_figure(path: Path, rows: Sequence[Row]) -> None:
    """Draw the errors of a sweep's rows. Raises DeniedError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    told = [{**row["values"], SCENE: row["scene"]} for row in rows]
    along, second, rest = _roles(told)
    across = scale(along, list(dict.fromkeys(one[along] for one in told)))
    figure: Any = Figure(figsize=(10, 6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    colours = _colours(list(dict.fromkeys(one[second] for one in told)) if second else [""])
    styles: dict[tuple[str, ...], tuple[str, str]] = {}
    for one in told:
        mark = tuple(one[key] for key in rest)
        styles.setdefault(mark, (MARKERS[len(styles) % len(MARKERS)], LINES[len(styles) % len(LINES)]))
    last = len(colours) * len(styles) - 1
    for place, (value, mark) in enumerate(product(colours, styles)):
        chosen = [
            row
            for row, one in zip(rows, told, strict=True)
            if (not second or one[second] == value) and tuple(one[key] for key in rest) == mark
        ]
        aside = (place - last / 2) / max(last, 1) * ASIDE
        _curve(panel, chosen, across, colours[value], styles[mark], aside)
    _furnish(panel, rows, across)
    handles = _legend(rows, (second, colours), (rest, styles))
    figure.legend(handles=handles, loc="outside right upper", fontsize=9)
    write_whole(path, lambda beside: figure.savefig(beside, format="png"))


def _roles(told: Sequence[Mapping[str, str]]) -> tuple[str, str, list[str]]:
    """The key along x, the one with a colour a value ("" if there is none), and the rest, of several values each."""
    counts = {key: len({one[key] for one in told}) for key in told[0]}
    keys = [key for key in counts if key != SCENE]
    along = max(keys, key=lambda key: counts[key])
    varied = sorted((key for key in counts if key != along and counts[key] > 1), key=lambda key: -counts[key])
    return along, (varied or [""])[0], varied[1:]


def _colours(values: Sequence[str]) -> dict[str, Any]:
    from matplotlib import colormaps

    shades: Any = colormaps["viridis"]
    last = max(len(values) - 1, 1)
    return {value: shades(0.88 * place / last) for place, value in enumerate(values)}


def _curve(panel: Any, rows: Sequence[Row], across: Scale, colour: Any, style: tuple[str, str], aside: float) -> None:
    """Those that failed are not drawn, and leave a gap. Points stand `aside`, so that curves do not hide each other's.

    aside : in 1/72 inch
    """
    from matplotlib.transforms import ScaledTranslation

    inch: Any = panel.figure.dpi_scale_trans
    beside: Any = panel.transData + ScaledTranslation(aside / 72, 0, inch)
    rows = sorted(rows, key=lambda row: across.places[row["values"][across.key]])
    x = [across.places[row["values"][across.key]] for row in rows]
    marker, line = style
    nothing = float("nan")
    panel.plot(x, [row.get("predicted_mse", nothing) for row in rows], linestyle=line, color=colour, linewidth=1.6)
    if len(x) == 1 or not any("mse" in row for row in rows):
        panel.plot(x, [row.get("predicted_mse", nothing) for row in rows], "_", color=colour, markersize=14)
    panel.vlines(
        x,
        [row.get("expected_low", nothing) for row in rows],
        [row.get("expected_high", nothing) for row in rows],
        color=colour,
        linewidth=3,
        alpha=0.3,
        transform=beside,
    )
    measured = [row.get("mse", nothing) for row in rows]
    points = {"marker": marker, "markersize": 6, "markeredgecolor": "white", "transform": beside}
    panel.plot(x, measured, linestyle="none", color=colour, **points)


def _furnish(panel: Any, rows: Sequence[Row], across: Scale) -> None:
    failed = sum("failed" in row for row in rows)
    scenes = ", ".join(dict.fromkeys(Path(row["scene"]).stem for row in rows))
    told = f"; {failed} of {len(rows)} failed, see sweep.csv" if failed else ""
    panel.set_title(f"Sweep of {scenes}{told}", fontsize=11)
    panel.set_xlabel(f"{across.key} ({across.unit})" if across.unit else across.key)
    panel.set_ylabel("mean squared error (squared units of f)")
    if across.logarithmic:
        panel.set_xscale("log")
    if across.categories or len(across.places) <= MOST_TICKS:
        panel.set_xticks(list(across.places.values()), [value.strip("\"'") for value in across.places])
        panel.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    if len(across.places) > MOST_TICKS // 2:
        panel.tick_params(axis="x", labelrotation=45)
    names = ("mse", "predicted_mse", "expected_low", "expected_high")
    errors = [row[name] for row in rows for name in names if name in row]
    if _spans(errors):
        panel.set_yscale("log")
        panel.set_ylim(min(errors) / MARGIN, max(errors) * MARGIN)
    else:
        panel.set_ylim(0, max(errors) * 1.1 or 1.0)
    panel.grid(visible=True, color="0.9")
    panel.set_axisbelow(True)


def _legend(
    rows: Sequence[Row],
    coloured: tuple[str, Mapping[str, Any]],
    styled: tuple[list[str], Mapping[tuple[str, ...], tuple[str, str]]],
) -> list[Any]:
    """What is measured and what predicted; then a colour a value, a marker and a line a combination."""
    from matplotlib.lines import Line2D

    drawn: Any = Line2D
    grey: dict[str, Any] = {"color": "0.3"}
    handles: list[Any] = [drawn([], [], **grey, label="predicted (Eq. 5)")]
    if any("mse" in row for row in rows):
        handles.append(drawn([], [], **grey, linestyle="none", marker="o", label="measured"))
    if any("expected_low" in row for row in rows):
        handles.append(drawn([], [], **grey, linewidth=3, alpha=0.3, label="99 % for this picture"))
    key, colours = coloured
    if key:
        handles += [drawn([], [], color=colour, linewidth=4, label=_told(key, v)) for v, colour in colours.items()]
    keys, styles = styled
    if keys:
        handles += [
            drawn([], [], **grey, marker=marker, linestyle=line, label="\n".join(map(_told, keys, values)))
            for values, (marker, line) in styles.items()
        ]
    return handles


def _told(key: str, value: str) -> str:
    return Path(value).stem if key == SCENE else f"{key} = {value}"


def _spans(values: Sequence[float]) -> bool:
    return bool(values) and min(values) > 0 and max(values) / min(values) >= DECADES
