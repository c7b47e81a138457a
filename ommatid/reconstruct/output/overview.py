"""Overview of a result: the truth, a sub-image of each lens type, the estimate, its error and its standard deviation.

Maps are drawn upright with pixels of the target along both axes; values are grey levels, 0 to 255. The verdict and the
error stand above them. All is in the files of a run, so that the figure can be drawn again in another format.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.panels import FigurePanel, FigureScale, draw_panel
from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.runtime.printable import printable_label
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.stack import Stack

from . import verdict_words
from .facts import headline
from .run_json import RunReport

OVERVIEW = "overview.png"
COLUMN_INCHES, ROW_INCHES = 3.4, 3.15
LEFT, RIGHT, TOP, BOTTOM = 0.75, 0.55, 1.25, 0.55  # inches around all panels; a layout by matplotlib takes a second
MOST_IN_A_ROW = 6
LEAST_SHARE = 0.01  # per cent of the expected error; smaller parts are not drawn
GOOD, DOUBT, BAD = "#17734a", "#8a5a00", "#b3261e"  # of the verdict


@own_style()
def write_overview(
    folder: Path, stack: Stack, channels: Mapping[str, Float32Array], report: RunReport, files: FigureFiles = SCREEN_PNG
) -> None:
    """Draw a result; channels : of its estimate.exr. Raises InputError or MachineError."""
    maps = result_panels(channels)
    sub_images = _sub_images(stack, maps["estimate"].scale)
    panels = [maps.pop("truth"), *sub_images, *maps.values()] if "truth" in maps else [*sub_images, *maps.values()]
    rows, across = grid(len(panels) + 1)
    width, height = COLUMN_INCHES * across, ROW_INCHES * rows + TOP - 0.35
    figure = new_figure(width, height)
    edges = {"left": LEFT / width, "right": 1 - RIGHT / width, "bottom": BOTTOM / height, "top": 1 - TOP / height}
    figure.subplots_adjust(**edges, wspace=0.5, hspace=0.45)
    _write_headline(figure, stack.scene.title, report)
    for index, panel in enumerate(panels):
        first = panel.scale not in [each.scale for each in panels[:index]]
        draw_panel(figure.add_subplot(rows, across, 1 + index), panel, bar=first)
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


def result_panels(channels: Mapping[str, Float32Array]) -> dict[str, FigurePanel]:
    """Return the panels of truth, estimate, error and deviation; without the truth those of estimate and deviation."""
    maps = {name: channel.astype(np.float64) for name, channel in channels.items()}
    estimate, truth, deviation = maps["estimate"], maps.get("truth"), np.sqrt(maps["variance"])
    grey = FigureScale.grey(estimate if truth is None else truth)
    panels = {} if truth is None else {"truth": FigurePanel("Truth", truth, grey)}
    panels["estimate"] = FigurePanel("Estimate", estimate, grey)
    if truth is not None:
        error = estimate - truth
        panels["error"] = FigurePanel("Error: estimate minus truth", error, FigureScale.signed(error))
    scale = FigureScale.deviation(deviation)
    return {**panels, "deviation": FigurePanel("Expected standard deviation", deviation, scale)}


def _draw_budget(axes: Any, report: RunReport) -> None:
    """Draw the parts of the expected error as bars, each below its cause, which leaves room for long names."""
    mse = report.error.predicted_mse
    parts = verdict_words.causes(report.error.budget, mse)
    shares = {name: share for name, _, share in parts if share > LEAST_SHARE}
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


def _sub_images(stack: Stack, grey: FigureScale) -> list[FigurePanel]:
    """Return the middle sub-image of each lens type."""
    panels: list[FigurePanel] = []
    subs = list(zip(stack.camera.sub_imagers, stack.images(), strict=True))
    for lens_type in stack.camera.types:
        members = [(sub, image) for sub, image in subs if sub.type == lens_type]
        sub, image = members[len(members) // 2]
        rows, columns = lens_type.array
        name = f"Type {lens_type.name}, sub-image {sub.k}, {sub.l} of {rows} x {columns}"
        masked = "" if lens_type.is_open else f", pixels open by {lens_type.opening}"
        title = f"{name}\nmagnification {1 / lens_type.ratio}{masked}"
        panels.append(FigurePanel(title, image, grey, "sensor pixels"))
    return panels


def sub_image_of(stack: Stack, name: str | None = None) -> tuple[SubImager, FloatArray]:
    """Return a sub-imager with its image, (rows, columns); name : None for the middle one of the finest type."""
    camera = stack.camera
    if name is None:
        finest = min(camera.types, key=lambda lens_type: lens_type.ratio)
        name = camera.sub_imager(camera.types.index(finest), finest.array[0] // 2, finest.array[1] // 2).name
    return next(pair for pair in zip(camera.sub_imagers, stack.images(), strict=True) if pair[0].name == name)


def placed_sub_image(stack: Stack, name: str | None, grey: FigureScale) -> FigurePanel:
    """Return a sub-image, as bright as f, where it looks at; name : None for the middle one of the finest type."""
    sub, image = sub_image_of(stack, name)
    name = sub.name
    place = float(sub.window[0]), float(sub.window[1]), float(sub.type.ratio)
    title = f"Sub-image {name}\nmagnification {1 / sub.type.ratio}"
    return FigurePanel(title, image / float(sub.type.light), grey, place=place)
