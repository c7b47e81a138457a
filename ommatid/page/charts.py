"""Charts of a page, drawn by Matplotlib as SVG whose text has the colour of the page's, and sentences about them.

Measured against predicted error: groups of pixels with similar posterior standard deviations. Their intervals allow for
the correlation of the errors: they are those of as many independent errors as have the same variance of their mean
square. Modulation transfer functions are those of the estimate and of the single sub-image. Error against time is that
of this run among the settings that `ommatid bench` measured for the same camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from markupsafe import Markup
from scipy import special

from ommatid.analysis import resolution
from ommatid.analysis.averaging_kernel import ErrorWindow, why_none
from ommatid.analysis.resolution import Transfer
from ommatid.bench.slopes import pareto_front
from ommatid.bench.table import STAGES, BenchTable
from ommatid.figures.saving import COLOURS, log_ticks, new_figure, own_style, svg_text
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.printable import printable_label
from ommatid.scenes.model import Model

from .data import Run, ShownSubImage

SIZE = 4.4, 3.4  # inches
LEGEND_ROW = 0.06  # of the height
GREY = "#808080"  # colour 0, legible on light and dark
LOOKS: dict[str, dict[str, Any]] = {
    "line": {"linewidth": 1.6},
    "dashed": {"linewidth": 1.3, "linestyle": "--"},
    "dots": {"linestyle": "none", "marker": "o", "markersize": 5},
    "rings": {"linestyle": "none", "marker": "o", "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 2},
}
GROUPS = 12
FEWEST_PIXELS = 20  # per group, on average
CONFIDENCE = 0.99
LOG_RATIO = 10  # ratio of the largest to the smallest error from which on the axes are logarithmic
Point = tuple[float, float]  # run time of a stage and mean squared error of the image, or the ends of an axis


@dataclass(frozen=True)
class ChartSeries:
    """Points of a chart: connected by a line, or drawn as dots or rings, with intervals from `low` to `high`, if any.

    name : in the legend, "" for none;  colour : number of a colour, 0 for grey
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    look: Literal["line", "dashed", "dots", "rings"] = "line"
    colour: int = 1
    low: Sequence[float] = ()
    high: Sequence[float] = ()


@own_style()
def chart(
    name: str,
    labels: tuple[str, str],
    series: Sequence[ChartSeries],
    description: str,
    ends: tuple[Point | None, Point | None] = (None, None),
    logarithmic: bool = False,
) -> Markup:
    """Return a chart as an SVG element.

    name : unique on its page;  description : for readers who do not see it
    labels, ends : of the axes along x and y, with units, None for ends as the values ask;  logarithmic : both axes
    """
    figure = new_figure(*SIZE)
    panel = figure.subplots()
    named = sum(bool(part.name) for part in series)
    figure.subplots_adjust(left=0.16, right=0.96, top=0.97 - LEGEND_ROW * named, bottom=0.15)
    for part in series:
        colour = COLOURS[part.colour - 1] if part.colour else GREY
        if part.low:
            panel.vlines(part.x, part.low, part.high, color=colour, linewidth=5, alpha=0.3)
        panel.plot(part.x, part.y, color=colour, label=printable_label(part.name), **LOOKS[part.look])
    scale = "log" if logarithmic else "linear"
    panel.set(xlabel=labels[0], ylabel=labels[1], xscale=scale, yscale=scale, xlim=ends[0], ylim=ends[1])
    for axis in (panel.xaxis, panel.yaxis) if logarithmic else ():
        log_ticks(axis)
    panel.grid(color=GREY, alpha=0.25)
    if named:  # above the panel, where it covers no points
        panel.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(-0.02, 0.99))
    return Markup(svg_text(figure, f"chart-{name}", description))


@dataclass(frozen=True)
class ErrorGroup:
    """RMS errors of a group of pixels: predicted from the posterior variance, and measured.

    degrees_of_freedom : number of independent errors whose mean square varies as much, None if it is not known
    interval : contains the measured error with 99 % probability if the errors are Gaussian (chi-squared), None without
        the degrees of freedom
    """

    pixels: int
    degrees_of_freedom: float | None
    predicted: float
    measured: float
    interval: tuple[float, float] | None

    @property
    def is_inside(self) -> bool:
        """True if the measured error is inside a known interval."""
        return self.interval is not None and self.interval[0] <= self.measured <= self.interval[1]


def error_groups(run: Run, window: ErrorWindow | None = None) -> list[ErrorGroup]:
    """Return the groups in order of increasing posterior standard deviation; none if the truth is not known.

    window : correlation of the errors, None for independent ones, or where `why_none` says that it is not known
    """
    if run.truth is None:
        return []
    errors = np.square(run.estimate.astype(np.float64) - run.truth).ravel()
    variances = run.variance.astype(np.float64).ravel()
    count = int(np.clip(errors.size // FEWEST_PIXELS, 1, GROUPS))
    edges = np.unique(np.quantile(variances, np.linspace(0, 1, count + 1)[1:-1]))
    # Pixels of equal variance, of which frames have many, belong to one group.
    group = np.searchsorted(edges, variances, side="left")
    is_unknown = window is None and bool(why_none(run.stack.scene))
    found: list[ErrorGroup] = []
    for index in np.unique(group):
        pixels = np.flatnonzero(group == index)
        freedom = float(pixels.size) if window is None else window.degrees_of_freedom(pixels)
        freedom = None if is_unknown else freedom
        found.append(_group(errors[pixels], variances[pixels], freedom))
    return found


def _group(errors: FloatArray, variances: FloatArray, freedom: float | None) -> ErrorGroup:
    predicted = float(np.sqrt(variances.mean()))
    interval = None
    if freedom is not None:
        low, high = (
            predicted * float(np.sqrt(2 * special.gammaincinv(freedom / 2, quantile) / freedom))
            for quantile in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
        )
        interval = low, high
    return ErrorGroup(int(errors.size), freedom, predicted, float(np.sqrt(errors.mean())), interval)


def error_chart(groups: list[ErrorGroup]) -> Markup:
    """Draw measured against predicted RMS error, with the line of equality and the 99 % intervals that are known."""
    intervals = [group.interval for group in groups if group.interval is not None]
    numbers = [value for group in groups for value in (group.predicted, group.measured)]
    numbers += [end for interval in intervals for end in interval]
    logarithmic = min(numbers) > 0 and max(numbers) > LOG_RATIO * min(numbers)
    ends = [min(group.predicted for group in groups), max(group.predicted for group in groups)]
    dots = ChartSeries(
        "measured, with the 99 % interval" if intervals else "measured",
        [group.predicted for group in groups],
        [group.measured for group in groups],
        "dots",
        low=[low for low, _ in intervals],
        high=[high for _, high in intervals],
    )
    equal = ChartSeries("measured equals predicted", ends, ends, "dashed", 0)
    labels = "predicted RMS error of a pixel", "measured RMS error of a pixel"
    return chart("errors", labels, [equal, dots], error_words(groups), logarithmic=logarithmic)


def error_words(groups: list[ErrorGroup]) -> str:
    """Return how many groups agree with the prediction, and how to interpret it."""
    inside = sum(group.is_inside for group in groups)
    ratios = [group.measured / group.predicted for group in groups if group.predicted > 0]
    sentence = f"{inside} of {len(groups)} groups are inside their intervals"
    if any(group.interval is None for group in groups):
        sentence = f"{len(groups)} groups without intervals, since the correlation of their errors is not known"
    if ratios:
        sentence += f"; the ratio of measured to predicted error is {min(ratios):.2f} to {max(ratios):.2f}"
    return f"{sentence}."


def resolution_content(run: Run, model: Model, window: ErrorWindow | None, single: ShownSubImage) -> dict[str, Any]:
    """Return the chart and its sentence, where the run has them, and what is left out.

    model : of f;  window : of the estimate's errors;  single : the sub-image that is shown
    """
    left_out = why_none(run.stack.scene)
    if window is None:
        return {"transfer": "", "left_out": left_out}
    found, sub = resolution.of_window(window), resolution.of_sub_image(model, window, single.name)
    series = [
        ChartSeries("estimate, along rows", list(found.frequencies), list(found.horizontal), "line", 1),
        ChartSeries("along columns", list(found.frequencies), list(found.vertical), "dashed", 1),
    ]
    if sub is not None:
        name = "a pixel of the single sub-image"
        series.append(ChartSeries(name, list(sub.frequencies), list(sub.horizontal), "line", 2))
    labels, ends = ("cycles per pixel", "contrast kept"), ((0.0, 0.5), (0.0, 1.1))
    drawn = chart("transfer", labels, series, "contrast of waves in the estimate, by frequency", ends)
    words = transfer_words(found, run.stack.camera.target_pitch)
    return {"transfer": drawn, "transfer_words": words, "left_out": left_out}


def transfer_words(transfer: Transfer, pitch: float) -> str:
    """Return where the contrast falls to half, in cycles per pixel and in line pairs per mm on the target."""
    half = transfer.half
    if half is None:
        least = min(float(transfer.horizontal[-1]), float(transfer.vertical[-1]))
        return (
            f"At the finest wave of the pixel grid, 0.5 cycles per pixel, {100 * least:.0f} % of the contrast is kept."
        )
    if half == 0:
        return "Less than half of any contrast is kept."
    on_target = f"{half / pitch:.3g} line pairs per mm on the target"
    return f"Half of the contrast is kept at {half:.2g} cycles per pixel, {on_target}."


def time_curves(run: Run, bench: BenchTable | None) -> tuple[Markup | str, str]:
    """Return the figure and its words, both empty if there is no bench or no measured error.

    Each stage has a colour: dots of its settings, the line of their Pareto front, and a ring of this run.
    """
    mse = run.report.error.mse
    if bench is None or mse is None:
        return "", ""
    series: list[ChartSeries] = []
    for colour, stage in enumerate(STAGES, 1):
        measured = [(cell.seconds, cell.mse) for cell in bench.cells if cell.stage == stage and cell.mse is not None]
        points: list[Point] = [point for point in measured if min(point) > 0]
        if points:
            front = pareto_front(points, lambda point: point[0], lambda point: point[1])
            own = [(run.report.stages[stage].seconds, mse)] if run.report.stages[stage].seconds > 0 else []
            series.append(ChartSeries("", *_columns(front), "line", colour))
            series.append(ChartSeries(stage, *_columns(points), "dots", colour))
            series.append(ChartSeries("", *_columns(own), "rings", colour))
    if not series:
        return "", ""
    words = f"The mean squared error of this run is {mse:.4g}."
    if bench.recommended.why:
        words += f" Recommendation of the bench: {bench.recommended.why.removesuffix('.')}."
    labels = "time of the stage (s)", "mean squared error"
    return chart("effort", labels, series, words, logarithmic=True), words


def _columns(points: list[Point]) -> tuple[list[float], list[float]]:
    return [seconds for seconds, _ in points], [mse for _, mse in points]
