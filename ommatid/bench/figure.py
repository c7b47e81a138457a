"""Figures of a bench: error against samples and against seconds, and the resulting error of the image.

Points are medians over seeds, error bars their 10 % and 90 % quantiles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, own_style
from ommatid.runtime.printable import printable_label

from .slopes import TOLERANCE, median_error, median_seconds, pareto_front
from .table import ALONE, AUTO, STAGES, BenchTable, Cell, ConvergenceCurve, Quantiles, Stage

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A4F9A", "#555555")  # Okabe and Ito
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")
FRONT: dict[str, Any] = {"color": "0.75", "linewidth": 7, "alpha": 0.6, "solid_capstyle": "round"}
ADAPTIVE: dict[str, Any] = {"markersize": 10, "markeredgecolor": "black", "linestyle": "none"}
BOX: dict[str, Any] = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
IMAGE_ERROR = "mean squared error of the image (grey levels squared)"


@dataclass(frozen=True)
class Style:
    """Colour and marker of a curve; slow backends and unrefined forms are hollow and dashed."""

    colour: str
    marker: str
    hollow: bool

    def line(self) -> dict[str, Any]:
        """Return the options of matplotlib's `plot`."""
        return {
            "color": self.colour,
            "marker": self.marker,
            "markersize": 5,
            "markerfacecolor": "white" if self.hollow else self.colour,
            "linewidth": 1.1,
            "linestyle": "--" if self.hollow else "-",
        }


Key = tuple[str, str | None]  # way, and variant or setting
Abscissa = Callable[[Cell], float | None]
Ordinate = Callable[[Cell], Quantiles | None]


@own_style()
def write_figures(folder: Path, table: BenchTable, files: FigureFiles = SCREEN_PNG) -> None:
    """Write a PNG for each stage that has cells: render.png, calibrate.png, reconstruct.png."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    for stage in STAGES:
        if not table.of(stage):
            continue
        figure: Any = Figure(figsize=(19, 7.4), layout="constrained")
        FigureCanvasAgg(figure)
        if stage == "reconstruct":
            _draw_reconstruction(figure, table)
        else:
            _draw_sampling(figure, table, stage)
        files.replace(figure, folder / f"{stage}.png")


def _draw_sampling(figure: Any, table: BenchTable, stage: Stage) -> None:
    """Draw error against samples with slopes, error against seconds, and the image's error against seconds."""
    unit = "RMS over sensor pixels (grey levels)" if stage == "render" else "RMS over entries of H"
    name = "Rendering" if stage == "render" else "Calibration"
    figure.suptitle(f"{name}: {printable_label(table.title)}")
    panels = figure.subplots(1, 3, width_ratios=(1.35, 1, 1))
    cells = table.of(stage)
    groups, styles = _groups([cell for cell in cells if cell.counted]), _styles(cells)
    axes: tuple[tuple[Abscissa, Ordinate], ...] = ((_samples, _error), (median_seconds, _error), (median_seconds, _mse))
    for panel, (x_of, y_of) in zip(panels, axes, strict=True):
        _prepare(panel)
        _draw_curves(panel, groups, styles, x_of, y_of)
    if stage == "render" and table.noise_deviation > 0:
        for panel in panels[:2]:
            _draw_level(panel, table.noise_deviation, f"noise of the sensor, {table.noise_deviation:.2g}")
    _draw_floor(panels[2], table)
    for panel, (x_of, y_of) in zip(panels, axes, strict=True):
        _draw_adaptive(panel, cells, styles, x_of, y_of)
    _label_slopes(panels[0], groups, styles, table.curves, stage)
    _draw_front(panels[1], cells)
    for panel in panels[1:]:
        panel.set_xlabel("time (s)")
    for panel in panels[:2]:
        panel.set_ylabel(f"error of the {name.lower()}: {unit}")
    panels[0].set_xlabel("samples per pixel (4: one pass, others: at least 16 passes; auto: the maximum over pixels)")
    panels[0].set_title(f"Convergence: slope ± standard error\nReference: {table.against}", fontsize=10)
    panels[1].set_title("Cost\n", fontsize=10)
    panels[2].set_ylabel(IMAGE_ERROR)
    panels[2].set_title(f"Error of the image\nwith exact {'H' if stage == 'render' else 'light'}", fontsize=10)
    _mark_recommended(panels[2], table, stage)
    _draw_legend(figure, groups, styles)


def _draw_reconstruction(figure: Any, table: BenchTable) -> None:
    """Draw numerical error, and the image's error, against seconds: one labelled mark per setting."""
    figure.suptitle(f"Reconstruction: {printable_label(table.title)}")
    panels = figure.subplots(1, 2, width_ratios=(1.5, 1))
    cells = table.of("reconstruct")
    groups: dict[Key, list[Cell]] = {(cell.way, cell.setting): [cell] for cell in cells}
    ways = list(dict.fromkeys(cell.way for cell in cells))
    styles: dict[Key, Style] = {(way, setting): _style(ways.index(way), setting == ALONE) for way, setting in groups}
    for panel, y_of in zip(panels, (_error, _mse), strict=True):
        _prepare(panel)
        panel.set_xlabel("time (s)")
        _draw_curves(panel, groups, styles, median_seconds, y_of)
    _draw_front(panels[0], cells)
    panels[0].legend(loc="lower left", fontsize=9)
    _draw_level(panels[0], 0.1, "0.1 posterior standard deviations: 1 % of the mean squared error")
    panels[0].set_ylabel("numerical error: RMS over pixels (posterior standard deviations)")
    panels[0].set_title("Distance from the exact estimate; hollow: a dense form without refinement", fontsize=10)
    labels: list[Label] = []
    for key, (cell,) in groups.items():
        text = f"{cell.way}, {cell.setting.split(',')[0]}"
        labels.append(Label(cell.seconds.median, cell.error.median, text, styles[key].colour))
    label_points(panels[0], labels, 1.7)
    panels[1].set_ylabel(IMAGE_ERROR)
    panels[1].set_title("Error of the image with exact light and H", fontsize=10)
    _draw_floor(panels[1], table)
    for key, (cell,) in groups.items():
        if cell.mse is not None and cell.mse.median > table.recommended.noise_floor * (1 + TOLERANCE / 2):
            text = {"xytext": (-8, 0), "textcoords": "offset points", "ha": "right", "va": "center", "fontsize": 8.5}
            point = cell.seconds.median, cell.mse.median
            panels[1].annotate(f"{cell.way}, {cell.setting}", point, color=styles[key].colour, **text)
    _mark_recommended(panels[1], table, "reconstruct")


def _samples(cell: Cell) -> float | None:
    return cell.samples


def _error(cell: Cell) -> Quantiles:
    return cell.error


def _mse(cell: Cell) -> Quantiles | None:
    return cell.mse


def _groups(cells: Sequence[Cell]) -> dict[Key, list[Cell]]:
    groups: dict[Key, list[Cell]] = {}
    for cell in sorted(cells, key=lambda cell: cell.samples or 0):
        groups.setdefault((cell.way, cell.variant), []).append(cell)
    return {key: groups[key] for key in dict.fromkeys((cell.way, cell.variant) for cell in cells)}


def _styles(cells: Sequence[Cell]) -> dict[Key, Style]:
    ways = list(dict.fromkeys(cell.way for cell in cells))
    keys = dict.fromkeys((cell.way, cell.variant) for cell in cells)
    return {(way, variant): _style(ways.index(way), (variant or "").startswith("scalar")) for way, variant in keys}


def _style(index: int, hollow: bool) -> Style:
    return Style(COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)], hollow)


def _prepare(panel: Any) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.grid(visible=True, which="major", color="0.9")
    panel.set_axisbelow(True)


def _draw_curves(
    panel: Any, groups: dict[Key, list[Cell]], styles: dict[Key, Style], x_of: Abscissa, y_of: Ordinate
) -> None:
    for key, cells in groups.items():
        points = [(x_of(cell), y_of(cell)) for cell in cells]
        known = [(x, y) for x, y in points if x is not None and y is not None and y.median > 0]
        if not known:
            continue
        below = [max(y.median - y.low, 0.0) for _, y in known]
        above = [y.high - y.median for _, y in known]
        panel.errorbar(
            [x for x, _ in known], [y.median for _, y in known], yerr=[below, above],
            elinewidth=0.8, capsize=1.5, zorder=3, **styles[key].line(),
        )  # fmt: skip
    values = {x for cells in groups.values() for x in map(x_of, cells) if x is not None}
    if len(values) == 1:  # around a single value, Matplotlib's limits of a logarithmic axis may coincide
        panel.update_datalim([(factor * value, 1.0) for value in values for factor in (0.5, 2.0)], updatey=False)


def _draw_adaptive(panel: Any, cells: Sequence[Cell], styles: dict[Key, Style], x_of: Abscissa, y_of: Ordinate) -> None:
    """Mark cells with samples "auto", which are on no curve, with a large marker and a label.

    Where their error is below the panel, because only rounding is left, the marker is on the lower edge and the label
    gives the error.
    """
    low, high = panel.get_ylim()
    cells = [cell for cell in cells if not cell.counted]
    known = [(x_of(cell), y_of(cell), styles[cell.way, cell.variant]) for cell in cells]
    points = [(x, y.median, style) for x, y, style in known if x is not None and y is not None]
    for x, y, style in points:
        panel.plot(x, max(y, low), zorder=5, clip_on=False, **{**style.line(), **ADAPTIVE})
    left, right = panel.get_xlim()
    middle = (left * right) ** 0.5
    for index, (x, y, style) in enumerate(points):
        label = f"{AUTO}, below: {y:.1g}" if y < low else AUTO
        offset = {"xytext": (-14 if x > middle else 14, 28 + 14 * index), "ha": "right" if x > middle else "left"}
        line = {"arrowstyle": "-", "color": style.colour, "linewidth": 0.8}
        text = {"textcoords": "offset points", "fontsize": 9, "fontweight": "bold", "bbox": BOX, "zorder": 6}
        panel.annotate(label, (x, max(y, low)), color=style.colour, arrowprops=line, **offset, **text)
    panel.set_ylim(low, high)


def _draw_front(panel: Any, cells: Sequence[Cell]) -> None:
    front = pareto_front(cells, median_seconds, median_error)
    panel.plot([median_seconds(cell) for cell in front], [median_error(cell) for cell in front], zorder=1,
               label="Pareto front", **FRONT)  # fmt: skip


def _draw_level(panel: Any, value: float, label: str) -> None:
    panel.axhline(value, color="0.35", linewidth=1, linestyle=":", zorder=2)
    panel.text(0.01, value, label, transform=panel.get_yaxis_transform(), va="bottom", fontsize=8, color="0.3")


def _draw_floor(panel: Any, table: BenchTable) -> None:
    floor = table.recommended.noise_floor
    if floor > 0:
        panel.axhspan(floor, floor * (1 + TOLERANCE), color="#009E73", alpha=0.15, linewidth=0, zorder=0)
        _draw_level(panel, floor, "")
        panel.annotate(
            f"noise floor {floor:.3g}, and {100 * TOLERANCE:g} % above it", (0.01, floor),
            xycoords=panel.get_yaxis_transform(), xytext=(0, -4), textcoords="offset points",
            va="top", fontsize=8, color="0.3",
        )  # fmt: skip
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, floor / (high / floor) ** 0.08), high)


def _mark_recommended(panel: Any, table: BenchTable, stage: Stage) -> None:
    best = table.recommended.of(stage)
    for cell in table.of(stage):
        if best is not None and cell.seconds.median == best.seconds and cell.mse is not None:
            point = cell.seconds.median, cell.mse.median
            panel.plot(*point, marker="o", markersize=15, markerfacecolor="none", color="black", zorder=5)
            label = "recommended" if table.recommended.reached else "nearest"
            text = {"textcoords": "offset points", "ha": "center", "fontsize": 9, "bbox": BOX, "zorder": 6}
            panel.annotate(label, point, xytext=(0, 12), **text)


def _label_slopes(
    panel: Any,
    groups: dict[Key, list[Cell]],
    styles: dict[Key, Style],
    curves: Sequence[ConvergenceCurve],
    stage: Stage,
) -> None:
    """Write each method's slope in its colour, for the first backend only: errors do not depend on the backend."""
    known = {(curve.way, curve.variant): curve for curve in curves if curve.stage == stage}
    first: dict[str, Key] = {}
    for way, variant in groups:
        first.setdefault(way, (way, variant))
    labels: list[Label] = []
    for key in first.values():
        last = groups[key][-1]
        text = _slope_words(key[0], known.get(key))
        labels.append(Label(float(last.samples or 1), last.error.median, text, styles[key].colour))
    most = max((cell.samples or 0 for cells in groups.values() for cell in cells), default=0)
    panel.set_xticks([4**power for power in range(1, 12) if 4**power <= most])
    panel.minorticks_off()
    panel.xaxis.set_major_formatter("{x:.0f}")
    label_points(panel, labels, 1.75)


def _slope_words(way: str, curve: ConvergenceCurve | None) -> str:
    if curve is None or curve.slope is None or curve.slope_deviation is None:
        return f"{way}: too few cells for a slope"
    theory = "" if curve.theory is None else f" (theory {curve.theory:g})"
    return f"{way}\n{curve.slope:.3f} ± {curve.slope_deviation:.3f}{theory}"


def _draw_legend(figure: Any, groups: dict[Key, list[Cell]], styles: dict[Key, Style]) -> None:
    from matplotlib.lines import Line2D

    lines: list[Any] = [Line2D([], [], **styles[key].line()) for key in groups]
    names = [way if variant is None else f"{way}, {variant}" for way, variant in groups]
    lines += [Line2D([], [], **FRONT), Line2D([], [], marker="o", markerfacecolor="0.7", color="0.7", **ADAPTIVE)]
    names += ["Pareto front", "auto: adaptive number of samples"]
    figure.legend(lines, names, loc="outside lower center", ncols=4, fontsize=9)


LINE_HEIGHT = 0.035  # distance between labels, as a fraction of the panel's height


class Label(NamedTuple):
    """The text of a point at (x, y), and its colour."""

    x: float
    y: float
    text: str
    colour: str


def label_points(panel: Any, labels: Sequence[Label], widening: float) -> None:
    """Write the labels in one column to the right of all points, each with a thin line to its point.

    widening : factor by which the span of the logarithmic x axis is extended to make room
    """
    left, right = panel.get_xlim()
    panel.set_xlim(left, left * (right / left) ** widening)
    low, high = np.log(panel.get_ylim())
    floor = float(panel.get_ylim()[0])  # where a logarithmic axis shows an error of 0
    rising = sorted((label._replace(y=max(label.y, floor)) for label in labels), key=lambda label: label.y)
    centers = [float((np.log(label.y) - low) / (high - low)) for label in rising]
    heights = [LINE_HEIGHT * (1 + label.text.count("\n")) for label in rising]
    for center, label in zip(_separated(centers, heights), rising, strict=True):
        line = {"arrowstyle": "-", "color": label.colour, "linewidth": 0.5, "alpha": 0.6, "relpos": (0, 0.5)}
        style = {"textcoords": "axes fraction", "va": "center", "fontsize": 8.5, "color": label.colour}
        panel.annotate(label.text, (label.x, label.y), xytext=(1.03 / widening, center), arrowprops=line, **style)


def _separated(centers: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Move rising positions between 0 and 1 apart until labels of these heights do not overlap."""
    moved: list[float] = []
    bottom = 0.0
    for center, height in zip(centers, heights, strict=True):
        moved.append(max(center, bottom + height / 2))
        bottom = moved[-1] + height / 2
    top = 1.0
    for index in reversed(range(len(moved))):
        moved[index] = min(moved[index], top - heights[index] / 2)
        top = moved[index] - heights[index] / 2
    return moved
