"""Figures of a bench: error against samples and against seconds, and the resulting error of the image.

Points are medians over seeds, error bars their 10 % and 90 % quantiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from pathlib import Path
from typing import Any

from ommatid.figures.curves import FRONT, MORE_COLOURS, Style, cycled, draw_curve, draw_level, label, legend
from ommatid.figures.saving import MARKERS, SCREEN_PNG, FigureFiles, log_ticks, new_figure, own_style
from ommatid.runtime.printable import printable_label

from .slopes import TOLERANCE, pareto_front
from .table import AUTO, STAGES, BenchTable, Cell, Stage

NAMES: dict[Stage, str] = {"render": "Rendering", "calibrate": "Calibration", "reconstruct": "Reconstruction"}
ERRORS: dict[Stage, str] = {
    "render": "error of the rendering: RMS over sensor pixels (grey levels)",
    "calibrate": "error of the calibration: RMS over entries of H",
    "reconstruct": "numerical error: RMS over pixels (posterior standard deviations)",
}
IMAGES: dict[Stage, str] = {"render": "exact H", "calibrate": "exact light", "reconstruct": "exact light and H"}
LABELS = {
    "samples": "samples per pixel",
    "seconds": "time (s)",
    "mse": "mean squared error of the image (grey levels squared)",
}
SHOWN = 0.3  # of the least error of the curves, below which nothing is drawn: only rounding is left


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
    cells, labels = table.of(stage), {**LABELS, "error": ERRORS[stage]}
    titles = {
        ("samples", "error"): f"Convergence: slope ± standard error\nReference: {table.against}",
        ("seconds", "error"): "Cost",
        ("seconds", "mse"): f"Error of the image with {IMAGES[stage]}",
    }
    if stage == "reconstruct":
        del titles["samples", "error"]
    panels = dict(zip(titles, figure.subplots(1, len(titles)), strict=True))
    styles = _styles(cells)
    for (x, y), panel in panels.items():
        label(panel, titles[x, y], labels[x], labels[y], "xy")
        log_ticks(panel.xaxis)
        for key, style in styles.items():
            _draw_way(panel, [cell for cell in cells if (cell.way, cell.variant) == key], style, (x, y), cells)
        if y == "error" and stage == "render" and table.noise_deviation > 0:
            draw_level(panel, table.noise_deviation, f"noise of the sensor, {table.noise_deviation:.2g}")
        if x == "samples":
            panel.set_xticks(sorted({4 ** round(log(cell.samples, 4)) for cell in cells if cell.samples}))
            panel.minorticks_off()
    cost = panels["seconds", "error"]
    front = pareto_front([cell for cell in cells if cell.error > 0], lambda cell: cell.seconds, lambda cell: cell.error)
    rows = [{"seconds": cell.seconds, "error": max(cell.error, _least(cells, "error"))} for cell in front]
    draw_curve(cost, rows, "seconds", "error", zorder=1, **FRONT)
    if stage == "reconstruct":
        draw_level(cost, 0.1, "0.1 posterior standard deviations: 1 % of the mean squared error")
    _draw_floor(panels["seconds", "mse"], table)
    _mark_recommended(panels["seconds", "mse"], table, stage)
    slopes = {
        (curve.way, curve.variant): curve.words or "too few cells for a slope"
        for curve in table.curves
        if curve.stage == stage
    }
    names = [", ".join(word for word in (*key, slopes.get(key)) if word) for key in styles]
    note = f"Pareto front; {AUTO}: adaptive number of samples" if stage != "reconstruct" else "Pareto front"
    entries = zip([*styles.values(), FRONT], [*names, note], strict=True)
    legend(figure, entries, loc="outside lower center", ncols=3)


def _styles(cells: Sequence[Cell]) -> dict[tuple[str, str | None], Style]:
    """Return the style of each way and variant: a colour and a marker, hollow for slow backends."""
    ways = list(dict.fromkeys(cell.way for cell in cells))
    styles: dict[tuple[str, str | None], Style] = {}
    for way, variant in dict.fromkeys((cell.way, cell.variant) for cell in cells):
        colour, hollow = cycled(ways.index(way), MORE_COLOURS), (variant or "").startswith("scalar")
        styles[way, variant] = {
            "color": colour,
            "marker": cycled(ways.index(way), MARKERS),
            "markersize": 5,
            "markerfacecolor": "white" if hollow else colour,
            "linewidth": 1.1,
            "linestyle": "--" if hollow else "-",
        }
    return styles


def _least(cells: Sequence[Cell], y: str) -> float:
    """Return the lower end of a panel; of smaller errors the name states the value."""
    return SHOWN * min((getattr(cell, y) for cell in cells if cell.counted and getattr(cell, y)), default=0.0)


def _draw_way(panel: Any, cells: Sequence[Cell], style: Style, axes: tuple[str, str], every: Sequence[Cell]) -> None:
    """Draw the cells of a way as a curve, those with a setting of their own as single points with its name.

    every : cells of the panel
    """
    (x, y), least = axes, _least(every, axes[1])
    rows = [cell.model_dump() for cell in cells if getattr(cell, x) is not None and (getattr(cell, y) or 0.0) > 0]
    rows.sort(key=lambda row: row["samples"] or 0)
    draw_curve(panel, [row for row in rows if row["samples"] and row["setting"] != AUTO], x, y, **style)
    for row in rows:
        if row["samples"] and row["setting"] != AUTO:
            continue
        name, value = row["setting"].split(",")[0], row[y]
        if value < least:
            name, row = f"{name}, below: {value:.1g}", {x: row[x], y: least}
        draw_curve(panel, [row], x, y, **style)
        place: Style = {"xytext": (6, 4), "textcoords": "offset points", "fontsize": 8}
        panel.annotate(name, (row[x], row[y]), color=style["color"], **place)
    if len({row[x] for row in rows}) == 1:  # around a single value, limits of a logarithmic axis may coincide
        panel.update_datalim([(factor * rows[0][x], 1.0) for factor in (0.5, 2.0)], updatey=False)


def _draw_floor(panel: Any, table: BenchTable) -> None:
    floor = table.recommended.noise_floor
    if floor > 0:
        panel.axhspan(floor, floor * (1 + TOLERANCE), color="#009E73", alpha=0.15, linewidth=0, zorder=0)
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, floor / (high / floor) ** 0.08), high)
        draw_level(panel, floor, f"noise floor {floor:.3g}, and {100 * TOLERANCE:g} % above it", "top")


def _mark_recommended(panel: Any, table: BenchTable, stage: Stage) -> None:
    best = getattr(table.recommended, stage)
    if best is not None and best.mse is not None:
        point = best.seconds, best.mse
        panel.plot(*point, marker="o", markersize=15, markerfacecolor="none", color="black", zorder=5)
        words = "recommended" if table.recommended.reached else "nearest"
        panel.annotate(words, point, xytext=(0, 12), textcoords="offset points", ha="center", fontsize=9)
