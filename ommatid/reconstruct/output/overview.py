"""Overview of a result: the truth, a sub-image of each lens type, the estimate, its error and its standard deviation.

Maps are drawn upright with pixels of the target along both axes; values are grey levels, 0 to 255. The verdict and the
error stand above them. All is in the files of a run, so that the figure can be drawn again in another format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.runtime.printable import printable_label
from ommatid.scenes.stack import Stack

from . import verdict_words
from .facts import headline
from .run_json import RunReport

OVERVIEW = "overview.png"
COLUMN_INCHES, ROW_INCHES = 3.4, 3.15
LEFT, RIGHT, TOP, BOTTOM = 0.75, 0.55, 1.25, 0.55  # inches around all panels; a layout by matplotlib takes a second
MOST_IN_A_ROW = 6
MOST_SHOWN = 480  # rows and columns of a map that a panel can show
LEAST_PART = 1e-4  # of the expected error; smaller parts are not drawn
GOOD, DOUBT, BAD = "#17734a", "#8a5a00", "#b3261e"  # of the verdict


@dataclass(frozen=True)
class OverviewPanel:
    """A map of the overview, and the colour scale that suits its content."""

    title: str
    image: FloatArray
    content: Literal["values", "recorded", "error", "deviation"]


@own_style()
def write_overview(
    folder: Path, stack: Stack, channels: Mapping[str, Float32Array], report: RunReport, files: FigureFiles = SCREEN_PNG
) -> None:
    """Draw a result; channels : of its estimate.exr. Raises InputError or MachineError."""
    maps = {name: channel.astype(np.float64) for name, channel in channels.items()}
    panels, grey = _panels(stack, maps), _grey_range(maps.get("truth", maps["estimate"]))
    rows, across = grid(len(panels) + 1)
    width, height = COLUMN_INCHES * across, ROW_INCHES * rows + TOP - 0.35
    figure = new_figure(width, height)
    edges = {"left": LEFT / width, "right": 1 - RIGHT / width, "bottom": BOTTOM / height, "top": 1 - TOP / height}
    figure.subplots_adjust(**edges, wspace=0.5, hspace=0.45)
    _write_headline(figure, stack.scene.title, report)
    for index, panel in enumerate(panels):
        _draw_panel(figure, figure.add_subplot(rows, across, 1 + index), panel, grey)
    _draw_budget(figure.add_subplot(rows, across, (len(panels) + 1, rows * across)), report)
    files.replace(figure, folder / OVERVIEW)


def grid(count: int) -> tuple[int, int]:
    """Return rows and columns for a number of panels; the last one is as wide as what is left of its row."""
    rows = max(2, -(-count // MOST_IN_A_ROW))
    return rows, -(-count // rows)


def _write_headline(figure: Any, title: str, report: RunReport) -> None:
    height = figure.get_figheight()
    figure.text(0.5, 1 - 0.28 / height, printable_label(title), fontsize=13, ha="center", va="center")
    heading = verdict_words.heading(report)
    colour = {"trusted": GOOD, "trusted with a doubt": DOUBT, "not to be trusted": BAD}.get(heading, "#000000")
    style: dict[str, Any] = {"fontsize": 12, "va": "center", "color": colour}
    words = f"{heading[:1].upper()}{heading[1:]}: {headline(report)}"
    figure.text(0.5, 1 - 0.58 / height, words, ha="center", fontweight="bold", **style)


def _panels(stack: Stack, maps: dict[str, FloatArray]) -> list[OverviewPanel]:
    """Return the maps in their order: what is given, then what is computed."""
    estimate, truth = maps["estimate"], maps.get("truth")
    panels = [] if truth is None else [OverviewPanel("Truth", truth, "values")]
    panels += [*_sub_images(stack), OverviewPanel("Estimate", estimate, "values")]
    if truth is not None:
        panels.append(OverviewPanel("Error: estimate minus truth", estimate - truth, "error"))
    deviation = np.sqrt(maps["variance"])
    return [*panels, OverviewPanel("Expected standard deviation", deviation, "deviation")]


def _draw_budget(axes: Any, report: RunReport) -> None:
    """Draw the parts of the expected error as bars, each below its cause, which leaves room for long names."""
    mse = report.error.predicted_mse
    parts = {name: part for name, part in report.error.budget.items() if part > LEAST_PART * mse}
    shares = {verdict_words.cause(name): 100 * part / mse for name, part in parts.items()}
    bars = axes.barh(range(len(shares)), list(shares.values()), height=0.45, color="tab:blue")
    axes.bar_label(
        bars, [f"{share:.2g} %" if share < 10 else f"{share:.0f} %" for share in shares.values()], padding=3, fontsize=8
    )
    for place, cause in enumerate(shares):
        axes.text(0, place - 0.3, f" {cause}", fontsize=8, va="bottom")
    axes.set_ylim(max(len(shares), 2) - 0.6, -0.75)
    axes.set_yticks([])
    axes.set_xlim(0, 1.25 * max(shares.values(), default=100))
    axes.set_title(f"Causes of the expected squared error, {mse:.3g}", fontsize=10)
    axes.set_xlabel("share (%)", fontsize=8)
    axes.tick_params(labelsize=8)


def _grey_range(image: FloatArray) -> tuple[float, float]:
    low, high = float(image.min()), float(image.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _sub_images(stack: Stack) -> list[OverviewPanel]:
    """Return the middle sub-image of each lens type."""
    panels: list[OverviewPanel] = []
    subs = list(zip(stack.camera.sub_imagers, stack.images(), strict=True))
    for lens_type in stack.camera.types:
        members = [(sub, image) for sub, image in subs if sub.type == lens_type]
        sub, image = members[len(members) // 2]
        rows, columns = lens_type.array
        name = f"Type {lens_type.name}, sub-image {sub.k}, {sub.l} of {rows} x {columns}"
        masked = "" if lens_type.is_open else f", pixels open by {lens_type.opening}"
        panels.append(OverviewPanel(f"{name}\nmagnification {1 / lens_type.ratio}{masked}", image, "recorded"))
    return panels


def _draw_panel(figure: Any, axes: Any, panel: OverviewPanel, grey: tuple[float, float]) -> None:
    low, high, colours, label = *grey, "gray", "grey level (0 to 255)"
    if panel.content == "error":
        high = float(np.abs(panel.image).max()) or 1.0
        low, colours, label = -high, "RdBu_r", "error (grey levels)"
    elif panel.content == "deviation":
        low, high, colours = 0.0, float(panel.image.max()) or 1.0, "viridis"
        label = "standard deviation (grey levels)"
    rows, columns = panel.image.shape
    each = max(1, max(rows, columns) // MOST_SHOWN)
    drawn = axes.imshow(
        panel.image[::each, ::each],
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation="nearest",
        extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
    )
    axes.set_title(panel.title, fontsize=10)
    unit = "sensor pixels" if panel.content == "recorded" else "target pixels"
    axes.set_xlabel(f"column ({unit})", fontsize=8)
    axes.set_ylabel(f"row ({unit})", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.yaxis.get_major_locator().set_params(integer=True)
    bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=8)
