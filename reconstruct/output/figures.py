"""Pictures of a result: the estimate as it is, and an overview with its error and its error bars.

Maps are drawn upright with pixels of the target along both axes; values are in the target's units, 0 to 255.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.files import write_whole
from ommatid.scenes.constants import WHITE
from ommatid.scenes.stack import Stack

from ..restore import Reconstruction

Image = NDArray[np.float64]

COLUMN_INCHES = 3.4
RESOLUTION = 110


def write_estimate(path: Path, estimate: Image) -> None:
    """Write an estimate, (rows, columns), as 8-bit PNG, a pixel for a pixel; values outside 0 to 255 are clipped."""
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
    above = _recorded(stack)
    below: list[tuple[str, Image, str]] = [("Estimate", estimate, "values")]
    if restoration.truth is not None:
        truth = restoration.truth.reshape(shape)
        above.insert(0, ("Truth", truth, "values"))
        below.append(("Error: estimate minus truth", estimate - truth, "signed"))
    deviation = np.sqrt(restoration.expected.variance).reshape(shape)
    below.append(("Expected deviation (error bars)", deviation, "spread"))
    across = max(len(above), len(below) + 1)
    figure: Any = Figure(figsize=(COLUMN_INCHES * across, 7.2), dpi=RESOLUTION, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    grey = _grey_range(restoration)
    for number, panels in enumerate((above, below)):
        for place, (name, image, kind) in enumerate(panels):
            _panel(figure, figure.add_subplot(2, across, 1 + number * across + place), name, image, kind, grey)
    _budget(figure.add_subplot(2, across, across + len(below) + 1), restoration)
    write_whole(path, lambda beside: figure.savefig(beside, format="png"))


def _budget(axes: Any, restoration: Reconstruction) -> None:
    parts = {name.replace("_", " "): part for name, part in restoration.budget().items() if part > 0}
    shares = [100 * part / restoration.expected.mse for part in parts.values()]
    bars = axes.barh(list(parts), shares, color="tab:blue")
    axes.bar_label(bars, [f"{share:.2g} %" for share in shares], padding=3, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.25 * max(shares))
    axes.set_box_aspect(0.9)
    axes.set_title(
        f"Where the expected squared error\nof {restoration.expected.mse:.3g} a pixel comes from", fontsize=10
    )
    axes.set_xlabel("share (%)", fontsize=8)
    axes.tick_params(labelsize=8)


def _grey_range(restoration: Reconstruction) -> tuple[float, float]:
    shown = restoration.estimate if restoration.truth is None else restoration.truth
    low, high = float(shown.min()), float(shown.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _recorded(stack: Stack) -> list[tuple[str, Image, str]]:
    """The middle sub-image of each lens type."""
    chosen: list[tuple[str, Image, str]] = []
    subs = list(zip(stack.camera.sub_imagers, stack.images(), strict=True))
    for kind in stack.camera.types:
        members = [(sub, image) for sub, image in subs if sub.type == kind]
        sub, image = members[len(members) // 2]
        name = f"Type {kind.name}, sub-image {sub.k}, {sub.l} of {kind.array[0]} x {kind.array[1]}"
        chosen.append((f"{name}\nmagnification {1 / kind.ratio}", image, "recorded"))
    return chosen


def _panel(figure: Any, axes: Any, name: str, image: Image, kind: str, grey: tuple[float, float]) -> None:
    low, high, colours, label = *grey, "gray", "value (0 to 255)"
    if kind == "signed":
        high = float(np.abs(image).max()) or 1.0
        low, colours, label = -high, "RdBu_r", "error (units of the values)"
    elif kind == "spread":
        low, high, colours, label = (
            0.0,
            float(image.max()) or 1.0,
            "viridis",
            "standard deviation (units of the values)",
        )
    drawn = axes.imshow(image, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    axes.set_title(name, fontsize=10)
    unit = "sensor pixels" if kind == "recorded" else "target pixels"
    axes.set_xlabel(f"column ({unit})", fontsize=8)
    axes.set_ylabel(f"row ({unit})", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.yaxis.get_major_locator().set_params(integer=True)
    bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=8)
