"""Images of a result: the estimate alone, and an overview with its error and its standard deviation.

Maps are drawn upright with pixels of the target along both axes; values are in the target's units, 0 to 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import write_whole
from ommatid.scenes.constants import WHITE
from ommatid.scenes.stack import Stack

from ..restore import Reconstruction

COLUMN_INCHES, ROW_INCHES = 3.4, 3.6
LEFT, RIGHT, TOP, BOTTOM = 0.75, 0.55, 0.95, 0.6  # inches around all panels; a layout by matplotlib takes a second
RESOLUTION = 110
MOST_SHOWN = 480  # rows and columns of a map that a panel can show


@dataclass(frozen=True)
class OverviewPanel:
    """A map of the overview, and the colour scale that suits its content."""

    title: str
    image: FloatArray
    content: Literal["values", "recorded", "error", "deviation"]


def write_estimate(path: Path, estimate: FloatArray) -> None:
    """Write an estimate, (rows, columns), as 8-bit PNG, one pixel each; values outside 0 to 255 are clipped."""
    from skimage import io

    pixels = np.clip(np.round(estimate), 0, WHITE).astype(np.uint8)
    imsave: Any = io.imsave  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    write_whole(path, lambda beside: imsave(beside, pixels, check_contrast=False))


def write_overview(path: Path, title: str, stack: Stack, restoration: Reconstruction) -> None:
    """Draw the truth, one sub-image of each lens type, the estimate, its error and its standard deviation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shape = restoration.shape
    estimate = restoration.estimate.reshape(shape)
    above, below = _sub_images(stack), [OverviewPanel("Estimate", estimate, "values")]
    if restoration.truth is not None:
        truth = restoration.truth.reshape(shape)
        above.insert(0, OverviewPanel("Truth", truth, "values"))
        below.append(OverviewPanel("Error: estimate minus truth", estimate - truth, "error"))
    deviation = np.sqrt(restoration.expected.variance).reshape(shape)
    below.append(OverviewPanel("Expected standard deviation", deviation, "deviation"))
    across = max(len(above), len(below) + 1)
    width, height = COLUMN_INCHES * across, 2 * ROW_INCHES
    figure: Any = Figure(figsize=(width, height), dpi=RESOLUTION)
    edges = {"left": LEFT / width, "right": 1 - RIGHT / width, "bottom": BOTTOM / height, "top": 1 - TOP / height}
    figure.subplots_adjust(**edges, wspace=0.5, hspace=0.55)
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    grey = _grey_range(restoration)
    for line, panels in enumerate((above, below)):
        for index, panel in enumerate(panels):
            _draw_panel(figure, figure.add_subplot(2, across, 1 + line * across + index), panel, grey)
    _draw_budget(figure.add_subplot(2, across, across + len(below) + 1), restoration)
    write_whole(path, lambda beside: figure.savefig(beside, format="png"))


def _draw_budget(axes: Any, restoration: Reconstruction) -> None:
    mse = restoration.expected.mse
    shares = {name.replace("_", " "): 100 * part / mse for name, part in restoration.budget().items() if part > 0}
    bars = axes.barh(list(shares), list(shares.values()), color="tab:blue")
    axes.bar_label(bars, [f"{share:.2g} %" for share in shares.values()], padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.5 * max(shares.values()))
    axes.set_box_aspect(1.4)
    axes.set_anchor("E")  # names stand on the left
    axes.set_title(f"Causes of the expected squared error\nof {mse:.3g} per pixel", fontsize=10, loc="right")
    axes.set_xlabel("share (%)", fontsize=8)
    axes.tick_params(labelsize=8)


def _grey_range(restoration: Reconstruction) -> tuple[float, float]:
    image = restoration.estimate if restoration.truth is None else restoration.truth
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
        panels.append(OverviewPanel(f"{name}\nmagnification {1 / lens_type.ratio}", image, "recorded"))
    return panels


def _draw_panel(figure: Any, axes: Any, panel: OverviewPanel, grey: tuple[float, float]) -> None:
    low, high, colours, label = *grey, "gray", "value (0 to 255)"
    if panel.content == "error":
        high = float(np.abs(panel.image).max()) or 1.0
        low, colours, label = -high, "RdBu_r", "error (units of the values)"
    elif panel.content == "deviation":
        low, high, colours = 0.0, float(panel.image.max()) or 1.0, "viridis"
        label = "standard deviation (units of the values)"
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
