"""Pictures of a bench: error against seconds and against samples, and what it does to the image.

Points are medians over seeds, bars their 10 % and 90 % quantiles; the Pareto front is what nothing else beats in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ommatid.runtime.files import write_whole

from .labels import Label, spread
from .slopes import WORSE, pareto
from .table import ALONE, AUTO, STAGES, BenchTable, Cell, ConvergenceCurve, Quantiles, Stage

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A4F9A", "#555555")  # Okabe and Ito
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")
RESOLUTION = 110
FRONT: dict[str, Any] = {"color": "0.75", "linewidth": 7, "alpha": 0.6, "solid_capstyle": "round"}
OPEN: dict[str, Any] = {"markersize": 10, "markeredgecolor": "black", "linestyle": "none"}


@dataclass(frozen=True)
class Style:
    """How a way is drawn: its colour and mark; slow backends are hollow and dashed."""

    colour: str
    marker: str
    hollow: bool

    def line(self) -> dict[str, Any]:
        """For `plot`."""
        face = "white" if self.hollow else self.colour
        return {
            "color": self.colour,
            "marker": self.marker,
            "markersize": 5,
            "markerfacecolor": face,
            "linewidth": 1.1,
            "linestyle": "--" if self.hollow else "-",
        }


Key = tuple[str, str | None]  # way, and variant or setting
Across = Callable[[Cell], float | None]
Up = Callable[[Cell], Quantiles | None]


def write_figures(folder: Path, table: BenchTable) -> None:
    """Write a PNG for each stage that has cells: render.png, calibrate.png, reconstruct.png."""
    for stage in STAGES:
        if table.of(stage):
            _write(folder / f"{stage}.png", table, stage, _by_way if stage == "reconstruct" else _by_samples)


def _write(path: Path, table: BenchTable, stage: Stage, draw: Callable[[Any, BenchTable, Stage], None]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(19, 7.4), dpi=RESOLUTION, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure, table, stage)
    write_whole(path, lambda beside: figure.savefig(beside, format="png"))


def _by_samples(figure: Any, table: BenchTable, stage: Stage) -> None:
    """Error against samples with slopes, error against seconds, and mean squared error of the image against seconds."""
    unit = "RMS over sensor pixels (values of f, 0 to 255)" if stage == "render" else "RMS over entries of H"
    what = "Rendering" if stage == "render" else "Calibration"
    figure.suptitle(f"{what}: {table.title}", parse_math=False)
    panels = figure.subplots(1, 3, width_ratios=(1.35, 1, 1))
    cells = table.of(stage)
    groups, styles = _groups([cell for cell in cells if cell.counted]), _styles(cells)
    for panel in panels:
        _furnish(panel)
    shown: tuple[tuple[Across, Up], ...] = ((_samples, _error), (_seconds, _error), (_seconds, _mse))
    for panel, (across, up) in zip(panels, shown, strict=True):
        _draw(panel, groups, styles, across, up)
    if stage == "render" and table.noise_deviation > 0:
        for panel in panels[:2]:
            _level(panel, table.noise_deviation, f"noise of the sensor, {table.noise_deviation:.2g}")
    _floor(panels[2], table)
    for panel, (across, up) in zip(panels, shown, strict=True):
        _as_needed(panel, cells, styles, across, up)
    _name_slopes(panels[0], groups, styles, table.curves, stage)
    _front(panels[1], pareto(cells))
    panels[0].set(
        xlabel="samples a pixel (4 in one pass, others in 16 passes or more; auto: the most on any pixel)",
        ylabel=f"error of the {what.lower()}: {unit}",
    )
    panels[0].set_title(f"How it falls: slope ± standard error\nagainst {table.against}", fontsize=10)
    panels[1].set(xlabel="seconds", ylabel=f"error of the {what.lower()}: {unit}")
    panels[1].set_title("What it costs\n", fontsize=10)
    panels[2].set(xlabel="seconds", ylabel="mean squared error of the image (squared values of f)")
    panels[2].set_title(
        f"What it brings: the image's error\nwith {'H' if stage == 'render' else 'light'} exact", fontsize=10
    )
    _star(panels[2], table, stage)
    _legend(figure, groups, styles)


def _by_way(figure: Any, table: BenchTable, stage: Stage) -> None:
    """Error, and mean squared error of the image, against seconds: one mark a setting, named beside it."""
    figure.suptitle(f"Reconstruction: {table.title}", parse_math=False)
    panels = figure.subplots(1, 2, width_ratios=(1.5, 1))
    cells = table.of(stage)
    groups: dict[Key, list[Cell]] = {(cell.way, cell.setting): [cell] for cell in cells}
    ways = list(dict.fromkeys(cell.way for cell in cells))
    styles: dict[Key, Style] = {(way, setting): _style(ways.index(way), setting == ALONE) for way, setting in groups}
    for panel in panels:
        _furnish(panel)
        panel.set_xlabel("seconds")
    _draw(panels[0], groups, styles, _seconds, _error)
    _front(panels[0], pareto(cells))
    panels[0].legend(loc="lower left", fontsize=9)
    _level(panels[0], 0.1, "a tenth of a posterior standard deviation: 1 % of the mean squared error")
    panels[0].set_ylabel("error of the computation: RMS over pixels (posterior standard deviations)")
    panels[0].set_title("How far from the exact answer; hollow: a dense form by itself, not refined", fontsize=10)
    labels = [
        (cell.seconds.median, cell.error.median, f"{cell.way}, {cell.setting.split(',')[0]}", styles[key].colour)
        for key, (cell,) in groups.items()
    ]
    spread(panels[0], labels, 1.7)
    _draw(panels[1], groups, styles, _seconds, _mse)
    panels[1].set_ylabel("mean squared error of the image (squared values of f)")
    panels[1].set_title("What it brings: the image's error with light and H exact", fontsize=10)
    _floor(panels[1], table)
    for key, (cell,) in groups.items():
        if cell.mse is not None and cell.mse.median > table.recommended["noise_floor"] * (1 + WORSE / 2):
            text = {"xytext": (-8, 0), "textcoords": "offset points", "ha": "right", "va": "center", "fontsize": 8.5}
            words, point = f"{cell.way}, {cell.setting}", (cell.seconds.median, cell.mse.median)
            panels[1].annotate(words, point, color=styles[key].colour, **text)
    _star(panels[1], table, stage)


def _samples(cell: Cell) -> float | None:
    return cell.samples


def _seconds(cell: Cell) -> float:
    return cell.seconds.median


def _error(cell: Cell) -> Quantiles:
    return cell.error


def _mse(cell: Cell) -> Quantiles | None:
    return cell.mse


def _groups(cells: Sequence[Cell]) -> dict[Key, list[Cell]]:
    found: dict[Key, list[Cell]] = {}
    for cell in cells:
        found.setdefault((cell.way, cell.variant), []).append(cell)
    return {key: sorted(some, key=lambda one: one.samples or 0) for key, some in found.items()}


def _styles(cells: Sequence[Cell]) -> dict[Key, Style]:
    ways = list(dict.fromkeys(cell.way for cell in cells))
    keys = dict.fromkeys((cell.way, cell.variant) for cell in cells)
    return {(way, variant): _style(ways.index(way), (variant or "").startswith("scalar")) for way, variant in keys}


def _style(number: int, hollow: bool) -> Style:
    return Style(COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)], hollow)


def _furnish(panel: Any) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.grid(visible=True, which="major", color="0.9")
    panel.set_axisbelow(True)


def _draw(
    panel: Any,
    groups: dict[Key, list[Cell]],
    styles: dict[Key, Style],
    across: Across,
    up: Up,
) -> None:
    for key, cells in groups.items():
        points = [(across(cell), up(cell)) for cell in cells]
        known = [(x, y) for x, y in points if x is not None and y is not None and y.median > 0]
        if not known:
            continue
        x, y = [one for one, _ in known], [one.median for _, one in known]
        bars = [[max(one.median - one.low, 0.0) for _, one in known], [one.high - one.median for _, one in known]]
        panel.errorbar(x, y, yerr=bars, elinewidth=0.8, capsize=1.5, zorder=3, **styles[key].line())


def _as_needed(panel: Any, cells: Sequence[Cell], styles: dict[Key, Style], across: Across, up: Up) -> None:
    """Mark cells of samples "auto", which lie on no curve: their way's mark, large and edged black, with a name.

    Where the panel ends above them, since only rounding is left, they stand on its lower edge, and the name says it.
    """
    low, high = panel.get_ylim()
    known = [(across(cell), up(cell), styles[cell.way, cell.variant]) for cell in cells if not cell.counted]
    points = [(x, y.median, style) for x, y, style in known if x is not None and y is not None]
    for x, y, style in points:
        panel.plot(x, max(y, low), zorder=5, clip_on=False, **{**style.line(), **OPEN})
    left, right = panel.get_xlim()
    middle = (left * right) ** 0.5
    for number, (x, y, style) in enumerate(points):
        words = f"{AUTO}, below: {y:.1g}" if y < low else AUTO
        place = {"xytext": (-14 if x > middle else 14, 28 + 14 * number), "ha": "right" if x > middle else "left"}
        leader = {"arrowstyle": "-", "color": style.colour, "linewidth": 0.8}
        behind = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
        text = {"textcoords": "offset points", "fontsize": 9, "fontweight": "bold", "bbox": behind, "zorder": 6}
        panel.annotate(words, (x, max(y, low)), color=style.colour, arrowprops=leader, **place, **text)
    panel.set_ylim(low, high)


def _front(panel: Any, front: Sequence[Cell]) -> None:
    x, y = [cell.seconds.median for cell in front], [cell.error.median for cell in front]
    panel.plot(x, y, zorder=1, label="Pareto front", **FRONT)


def _level(panel: Any, value: float, words: str) -> None:
    panel.axhline(value, color="0.35", linewidth=1, linestyle=":", zorder=2)
    panel.text(0.01, value, words, transform=panel.get_yaxis_transform(), va="bottom", fontsize=8, color="0.3")


def _floor(panel: Any, table: BenchTable) -> None:
    floor = table.recommended["noise_floor"]
    if floor and floor > 0:
        panel.axhspan(floor, floor * (1 + WORSE), color="#009E73", alpha=0.15, linewidth=0, zorder=0)
        _level(panel, floor, "")
        words = f"noise floor {floor:.3g}, and {100 * WORSE:g} % above it"
        panel.annotate(
            words, (0.99, floor), xycoords=panel.get_yaxis_transform(), xytext=(0, -4), textcoords="offset points",
            va="top", ha="right", fontsize=8, color="0.3",
        )  # fmt: skip
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, floor / (high / floor) ** 0.08), high)


def _star(panel: Any, table: BenchTable, stage: Stage) -> None:
    """Ring the cell that is recommended."""
    best = table.recommended.get(stage)
    for cell in table.of(stage):
        same = best is not None and cell.seconds.median == best["seconds"]
        if same and cell.mse is not None:
            point = cell.seconds.median, cell.mse.median
            panel.plot(*point, marker="o", markersize=15, markerfacecolor="none", color="black", zorder=5)
            name = "recommended" if table.recommended["reached"] else "nearest"
            behind = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
            text = {"textcoords": "offset points", "ha": "center", "fontsize": 9, "bbox": behind, "zorder": 6}
            panel.annotate(name, point, xytext=(0, 12), **text)


def _name_slopes(
    panel: Any,
    groups: dict[Key, list[Cell]],
    styles: dict[Key, Style],
    curves: Sequence[ConvergenceCurve],
    stage: Stage,
) -> None:
    """The slopes of all ways, each in its colour; those of the first backend, since errors do not depend on it."""
    known = {(one.way, one.variant): one for one in curves if one.stage == stage}
    labels: list[Label] = []
    for key, cells in groups.items():
        if key == next(one for one in groups if one[0] == key[0]):
            words = _slope_words(key[0], known.get(key))
            labels.append((float(cells[-1].samples or 1), cells[-1].error.median, words, styles[key].colour))
    most = max((cell.samples or 0 for cells in groups.values() for cell in cells), default=0)
    panel.set_xticks([4**power for power in range(1, 12) if 4**power <= most])
    panel.minorticks_off()
    panel.xaxis.set_major_formatter("{x:.0f}")
    spread(panel, labels, 1.75)


def _slope_words(way: str, curve: ConvergenceCurve | None) -> str:
    if curve is None or curve.slope is None or curve.slope_deviation is None:
        return f"{way}: too few cells for a slope"
    beside = "" if curve.theory is None else f" (theory {curve.theory:g})"
    return f"{way}\n{curve.slope:.3f} ± {curve.slope_deviation:.3f}{beside}"


def _legend(figure: Any, groups: dict[Key, list[Cell]], styles: dict[Key, Style]) -> None:
    from matplotlib.lines import Line2D

    lines: list[Any] = [Line2D([], [], **styles[key].line()) for key in groups]
    names = [way if variant is None else f"{way}, {variant}" for way, variant in groups]
    lines += [Line2D([], [], **FRONT), Line2D([], [], marker="o", markerfacecolor="0.7", color="0.7", **OPEN)]
    names += ["Pareto front: nothing is both faster and better", "auto: as many samples as are needed"]
    figure.legend(lines, names, loc="outside lower center", ncols=4, fontsize=9)
