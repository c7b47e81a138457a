"""Figures of a bench: error against samples and against seconds, and the resulting error of the image.

Points are medians over seeds, error bars their 10 % and 90 % quantiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from pathlib import Path
from typing import Any

from ommatid.figures.saving import COLOURS, MARKERS, SCREEN_PNG, FigureFiles, log_ticks, new_figure, own_style
from ommatid.runtime.printable import printable_label

from .slopes import TOLERANCE, median_error, median_seconds, pareto_front
from .table import AUTO, STAGES, BenchTable, Cell, ConvergenceCurve, Quantiles, Stage

MORE_COLOURS = (*COLOURS, "#7A4F9A", "#555555")
FRONT: dict[str, Any] = {"color": "0.75", "linewidth": 7, "alpha": 0.6, "solid_capstyle": "round"}
NAMES: dict[Stage, str] = {"render": "Rendering", "calibrate": "Calibration", "reconstruct": "Reconstruction"}
ERRORS: dict[Stage, str] = {
    "render": "error of the rendering: RMS over sensor pixels (grey levels)",
    "calibrate": "error of the calibration: RMS over entries of H",
    "reconstruct": "numerical error: RMS over pixels (posterior standard deviations)",
}
IMAGES: dict[Stage, str] = {"render": "exact H", "calibrate": "exact light", "reconstruct": "exact light and H"}
IMAGE_ERROR = "mean squared error of the image (grey levels squared)"

Key = tuple[str, str | None]  # way and variant


@own_style()
def write_figures(folder: Path, table: BenchTable, files: FigureFiles = SCREEN_PNG) -> None:
    """Write a PNG for each stage that has cells: render.png, calibrate.png, reconstruct.png."""
    for stage in STAGES:
        if table.of(stage):
            figure = new_figure(19, 7.4, layout="constrained")
            _draw(figure, table, stage)
            files.replace(figure, folder / f"{stage}.png")


def _draw(figure: Any, table: BenchTable, stage: Stage) -> None:
    """Draw error against samples where a stage takes them, error against seconds, and the image's against seconds."""
    figure.suptitle(f"{NAMES[stage]}: {printable_label(table.title)}")
    cells = table.of(stage)
    axes = [("seconds", "error"), ("seconds", "mse")]
    if stage != "reconstruct":
        axes.insert(0, ("samples", "error"))
    panels = figure.subplots(1, len(axes))
    for panel, (across, along) in zip(panels, axes, strict=True):
        _prepare(panel)
        least = 0.3 * min(
            (y.median for cell in cells if cell.counted and (y := getattr(cell, along)) and y.median), default=0.0
        )
        for key, style in _styles(cells).items():
            _draw_cells(panel, [cell for cell in cells if (cell.way, cell.variant) == key], style, across, along, least)
        panel.set_xlabel("samples per pixel" if across == "samples" else "time (s)")
        panel.set_ylabel(ERRORS[stage] if along == "error" else IMAGE_ERROR)
    *first, cost, image = panels
    for panel in first:
        panel.set_title(f"Convergence: slope ± standard error\nReference: {table.against}", fontsize=10)
        panel.set_xticks(sorted({4 ** round(log(cell.samples, 4)) for cell in cells if cell.samples}))
        panel.minorticks_off()
    cost.set_title("Cost", fontsize=10)
    image.set_title(f"Error of the image with {IMAGES[stage]}", fontsize=10)
    front = [cell for cell in pareto_front(cells, median_seconds, median_error) if median_error(cell) > 0]
    least = 0.3 * min((median_error(cell) for cell in cells if cell.counted), default=0.0)
    if front:  # an exact answer is no point of a logarithmic axis
        errors = [max(median_error(cell), least) for cell in front]
        cost.plot([median_seconds(cell) for cell in front], errors, zorder=1, **FRONT)
    if stage == "render" and table.noise_deviation > 0:
        for panel in (*first, cost):
            _draw_level(panel, table.noise_deviation, f"noise of the sensor, {table.noise_deviation:.2g}")
    if stage == "reconstruct":
        _draw_level(cost, 0.1, "0.1 posterior standard deviations: 1 % of the mean squared error")
    _draw_floor(image, table)
    _mark_recommended(image, table, stage)
    _draw_legend(figure, table, stage)


def _styles(cells: Sequence[Cell]) -> dict[Key, dict[str, Any]]:
    """Return the options of matplotlib's `plot` for each way: a colour and a marker, hollow for slow backends."""
    ways = list(dict.fromkeys(cell.way for cell in cells))
    styles: dict[Key, dict[str, Any]] = {}
    for way, variant in dict.fromkeys((cell.way, cell.variant) for cell in cells):
        index, hollow = ways.index(way), (variant or "").startswith("scalar")
        colour = MORE_COLOURS[index % len(MORE_COLOURS)]
        styles[way, variant] = {
            "color": colour,
            "marker": MARKERS[index % len(MARKERS)],
            "markersize": 5,
            "markerfacecolor": "white" if hollow else colour,
            "linewidth": 1.1,
            "linestyle": "--" if hollow else "-",
        }
    return styles


def _prepare(panel: Any) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    log_ticks(panel.xaxis)
    panel.grid(visible=True, which="major", color="0.9")
    panel.set_axisbelow(True)


def _draw_cells(
    panel: Any, cells: Sequence[Cell], style: dict[str, Any], across: str, along: str, least: float
) -> None:
    """Draw the cells of a way as a curve, those with a setting of their own as single points with its name.

    across, along : names of the numbers at x and y
    least : lower end of the panel: of smaller errors, where only rounding is left, the name states the value
    """
    known: list[tuple[float, Quantiles, Cell]] = []
    for cell in sorted(cells, key=lambda cell: cell.samples or 0):
        x, y = cell.samples if across == "samples" else cell.seconds.median, getattr(cell, along)
        if x is not None and y is not None and y.median > 0:
            known.append((x, y, cell))
    curve = [(x, y) for x, y, cell in known if cell.counted and cell.samples is not None]
    single = [(x, y) for x, y, _ in known if y.median >= least and (x, y) not in curve]
    for points, options in ((curve, style), (single, {**style, "linestyle": "none"})):
        if not points:  # which Matplotlib warns of on a logarithmic axis
            continue
        below = [max(y.median - y.low, 0.0) for _, y in points]
        above = [y.high - y.median for _, y in points]
        medians = [y.median for _, y in points]
        panel.errorbar([x for x, _ in points], medians, yerr=[below, above], elinewidth=0.8, capsize=1.5, **options)
    for x, y, cell in known:
        if cell.samples is None or not cell.counted:
            name, offset = cell.setting.split(",")[0], {"xytext": (6, 4), "textcoords": "offset points", "fontsize": 8}
            if y.median < least:
                panel.plot(x, least, **style)
                name = f"{name}, below: {y.median:.1g}"
            panel.annotate(name, (x, max(y.median, least)), color=style["color"], **offset)
    if len({x for x, _, _ in known}) == 1:  # around a single value, limits of a logarithmic axis may coincide
        panel.update_datalim([(factor * known[0][0], 1.0) for factor in (0.5, 2.0)], updatey=False)


def _draw_level(panel: Any, value: float, label: str, side: str = "bottom") -> None:
    panel.axhline(value, color="0.35", linewidth=1, linestyle=":", zorder=2)
    panel.text(0.01, value, label, transform=panel.get_yaxis_transform(), va=side, fontsize=8, color="0.3")


def _draw_floor(panel: Any, table: BenchTable) -> None:
    floor = table.recommended.noise_floor
    if floor > 0:
        panel.axhspan(floor, floor * (1 + TOLERANCE), color="#009E73", alpha=0.15, linewidth=0, zorder=0)
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, floor / (high / floor) ** 0.08), high)
        _draw_level(panel, floor, f"noise floor {floor:.3g}, and {100 * TOLERANCE:g} % above it", "top")


def _mark_recommended(panel: Any, table: BenchTable, stage: Stage) -> None:
    best = table.recommended.of(stage)
    for cell in table.of(stage):
        if best is not None and cell.seconds.median == best.seconds and cell.mse is not None:
            point = cell.seconds.median, cell.mse.median
            panel.plot(*point, marker="o", markersize=15, markerfacecolor="none", color="black", zorder=5)
            label = "recommended" if table.recommended.reached else "nearest"
            panel.annotate(label, point, xytext=(0, 12), textcoords="offset points", ha="center", fontsize=9)


def _draw_legend(figure: Any, table: BenchTable, stage: Stage) -> None:
    """Name the ways with their slopes, below all panels."""
    from matplotlib.lines import Line2D

    slopes = {(curve.way, curve.variant): _slope_words(curve) for curve in table.curves if curve.stage == stage}
    styles = _styles(table.of(stage))
    lines: list[Any] = [*(Line2D([], [], **style) for style in styles.values()), Line2D([], [], **FRONT)]
    names = [", ".join(word for word in (*key, slopes.get(key)) if word) for key in styles]
    note = f"Pareto front; {AUTO}: adaptive number of samples" if stage != "reconstruct" else "Pareto front"
    figure.legend(lines, [*names, note], loc="outside lower center", ncols=3, fontsize=9)


def _slope_words(curve: ConvergenceCurve) -> str:
    if curve.slope is None or curve.slope_deviation is None:
        return "too few cells for a slope"
    theory = "" if curve.theory is None else f" (theory {curve.theory:g})"
    return f"{curve.slope:.3f} ± {curve.slope_deviation:.3f}{theory}"
