"""Figure of the digits lost by every form against the noise variance.

Three panels per H: the form alone, refined, and the worst posterior variance. Refusals are marked above the curves.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, own_style

from .outcome import SweepOutcome

FLOAT64_DIGITS = 16.0
PANELS = (("alone", "estimate, the form alone"), ("refined", "estimate, refined"), ("variance", "worst variance"))
STYLES = {
    "covariance": ("tab:orange", "v"),
    "information": ("tab:red", "s"),
    "square-root-information": ("tab:purple", "D"),
    "square-root-covariance": ("tab:brown", "^"),
    "svd": ("tab:green", "o"),
    "dual": ("tab:blue", "P"),
    "auto": ("black", "x"),
}
FIRST_LANE, LANE_HEIGHT = FLOAT64_DIGITS + 1.5, 0.75  # of the marks of refusals, one lane per form
TITLES = {"three": "three types: H has full rank", "two": "two types: H has a null space"}
_TEXT = {"ha": "right", "fontsize": 8, "color": "0.4"}


@own_style()
def write_figure(path: Path, curves: list[SweepOutcome], files: FigureFiles = SCREEN_PNG) -> None:
    """Draw the digits lost, with one row of panels per H and one column per quantity."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(14, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(TITLES), len(PANELS), sharex=True, sharey=True)
    for row, (lenses, title) in enumerate(TITLES.items()):
        for column, (field, quantity) in enumerate(PANELS):
            panel = axes[row][column]
            for lane, form in enumerate(STYLES):
                points = [point for point in curves if point.lenses == lenses and point.outcome.asked == form]
                _draw_form(panel, points, field, form, FIRST_LANE + lane * LANE_HEIGHT)
            _draw_axes(panel)
            panel.set_title(f"{title}\n{quantity}", fontsize=10)
            panel.set_xlabel("noise variance (grey levels squared)")
            panel.set_ylabel("decimal digits lost, of 16")
            panel.tick_params(labelleft=True, labelbottom=True)
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle("Digits lost by the forms of the estimator, against exact arithmetic")
    files.replace(figure, path)


def _draw_axes(panel: Any) -> None:
    top = FIRST_LANE + len(STYLES) * LANE_HEIGHT
    panel.set_xscale("log")
    panel.set_ylim(-0.5, top)
    panel.set_yticks(range(0, int(FLOAT64_DIGITS) + 1, 2))
    panel.grid(visible=True, color="0.9")
    panel.axhline(FLOAT64_DIGITS - 9, color="0.5", linewidth=1, linestyle=":")
    panel.axhspan(FIRST_LANE - LANE_HEIGHT, top, color="0.95", zorder=0)
    along = panel.get_yaxis_transform()
    panel.text(0.99, FLOAT64_DIGITS - 8.9, "nine digits left", **_TEXT, transform=along, va="bottom")
    panel.text(0.99, top - 0.3, "refused", **_TEXT, transform=along, va="top")


def _draw_form(panel: Any, points: list[SweepOutcome], field: str, form: str, lane: float) -> None:
    """Draw the digits lost by a form, and hollow marks in its lane where it refuses."""
    colour, marker = STYLES[form]
    values = [getattr(point.outcome, field) for point in points]
    lost = [float("nan") if value is None else FLOAT64_DIGITS - value for value in values]
    style = {"linewidth": 2.2, "markersize": 6, "zorder": 5} if form == "auto" else {"linewidth": 1.2, "markersize": 5}
    panel.plot([point.noise for point in points], lost, color=colour, marker=marker, label=form, **style)
    refused = [point.noise for point, value in zip(points, values, strict=True) if value is None]
    hollow = {"markerfacecolor": "none", "markersize": 5, "linestyle": "none"}
    panel.plot(refused, [lane] * len(refused), color=colour, marker=marker, **hollow)
