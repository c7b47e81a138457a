"""Digits that every form loses, against the noise variance: alone, refined, and of the worst posterior variance.

What a form refuses stands above, in a lane of its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ommatid.runtime.files import write_whole

from .outcome import SweepOutcome

HELD = 16.0  # digits of float64
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
LANES, APART = HELD + 1.5, 0.75  # where refusals begin, and how far apart two forms' are
_TEXT = {"ha": "right", "fontsize": 8, "color": "0.4"}
WORDS = {"three": "three types: H has full rank", "two": "two types: H has a null space"}


def write_figure(path: Path, curves: list[SweepOutcome]) -> None:
    """Draw digits lost: a row a kind of H, a column what lost them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(14, 9.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(WORDS), len(PANELS), sharex=True, sharey=True)
    for row, (lenses, words) in enumerate(WORDS.items()):
        for column, (field, title) in enumerate(PANELS):
            panel = axes[row][column]
            for lane, form in enumerate(STYLES):
                points = [one for one in curves if one.lenses == lenses and one.outcome.asked == form]
                _line(panel, points, field, form, LANES + lane * APART)
            _furnish(panel)
            panel.set_title(f"{words}\n{title}", fontsize=10)
            if row == len(WORDS) - 1:
                panel.set_xlabel("noise variance (squared units of f)")
            if column == 0:
                panel.set_ylabel("digits lost, of 16")
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle("Digits lost by the forms of the estimator, against exact arithmetic")
    write_whole(path, lambda beside: figure.savefig(beside, format="png"))


def _furnish(panel: Any) -> None:
    top = LANES + len(STYLES) * APART
    panel.set_xscale("log")
    panel.set_ylim(-0.5, top)
    panel.set_yticks(range(0, int(HELD) + 1, 2))
    panel.grid(visible=True, color="0.9")
    panel.axhline(HELD - 9, color="0.5", linewidth=1, linestyle=":")
    panel.axhspan(LANES - APART, top, color="0.95", zorder=0)
    panel.text(0.99, HELD - 8.9, "nine digits left", **_TEXT, transform=panel.get_yaxis_transform(), va="bottom")
    panel.text(0.99, top - 0.3, "refused", **_TEXT, transform=panel.get_yaxis_transform(), va="top")


def _line(panel: Any, points: list[SweepOutcome], field: str, form: str, lane: float) -> None:
    """A form's digits, and hollow marks in its lane where it has none because it refuses."""
    colour, marker = STYLES[form]
    values = [getattr(one.outcome, field) for one in points]
    lost = [float("nan") if value is None else HELD - value for value in values]
    style = {"linewidth": 2.2, "markersize": 6, "zorder": 5} if form == "auto" else {"linewidth": 1.2, "markersize": 5}
    panel.plot([one.noise for one in points], lost, color=colour, marker=marker, label=form, **style)
    refused = [one.noise for one, value in zip(points, values, strict=True) if value is None]
    hollow = {"markerfacecolor": "none", "markersize": 5, "linestyle": "none"}
    panel.plot(refused, [lane] * len(refused), color=colour, marker=marker, **hollow)
