"""Digits that every form loses, against the noise variance: alone, refined, and of the worst posterior variance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.files import write_whole

if TYPE_CHECKING:
    from .stability import Swept

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
WORDS = {"three": "three types: H has full rank", "two": "two types: H has a null space"}


def write_figure(path: Path, curves: list[Swept]) -> None:
    """Draw digits lost: a row a kind of H, a column what lost them; a form's line ends where it is refused."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(14, 8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(WORDS), len(PANELS), sharex=True, sharey=True)
    for row, (lenses, words) in enumerate(WORDS.items()):
        for column, (field, title) in enumerate(PANELS):
            panel = axes[row][column]
            for form, (colour, marker) in STYLES.items():
                points = [one for one in curves if one.lenses == lenses and one.outcome.asked == form]
                _line(panel, points, field, form, colour, marker)
            panel.set_xscale("log")
            panel.set_title(f"{words}\n{title}", fontsize=10)
            panel.grid(visible=True, color="0.88")
            panel.axhline(HELD - 9, color="0.5", linewidth=1, linestyle=":")
            if row == len(WORDS) - 1:
                panel.set_xlabel("noise variance (squared units of f)")
            if column == 0:
                panel.set_ylabel("digits lost, of 16")
    axes[0][0].set_ylim(-0.5, HELD + 0.5)
    axes[0][0].annotate("nine digits left", (1e12, HELD - 9), ha="right", va="bottom", fontsize=8, color="0.4")
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    figure.suptitle("Digits lost by the forms of the estimator; a line ends where its form refuses")
    write_whole(path, lambda beside: figure.savefig(beside, format="png"))


def _line(panel: Any, points: list[Swept], field: str, form: str, colour: str, marker: str) -> None:
    values = [getattr(one.outcome, field) for one in points]
    lost = [float("nan") if value is None else HELD - value for value in values]
    style = {"linewidth": 2.2, "markersize": 6, "zorder": 5} if form == "auto" else {"linewidth": 1.2, "markersize": 5}
    panel.plot([one.noise for one in points], lost, color=colour, marker=marker, label=form, **style)
