"""Panels of figures: maps, upright and with square pixels, each with the colour scale that suits its content.

Maps are (rows, columns). Their scales are common where they are equal: a bar then serves several panels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.constants import WHITE

BAR, PAD = 0.046, 0.03  # width of a bar and the gap before it, as shares of a panel's room
MOST_SHOWN = 480  # rows and columns of a map that a panel of a screen can show


@dataclass(frozen=True)
class FigureScale:
    """The values at the ends of a colour scale, Matplotlib's name of its colours, and the quantity with its unit."""

    low: float
    high: float
    colours: str
    label: str

    @classmethod
    def grey(cls, *images: NDArray[Any], aside: float = 0.0) -> FigureScale:
        """Return the grey scale of the values of images without `aside` per cent of them at either end."""
        low, high = _range(images, aside) or (0.0, WHITE)
        return cls(*((low, high) if high > low else (low - 0.5, high + 0.5)), "gray", "grey level (0 to 255)")

    @classmethod
    def signed(cls, *errors: NDArray[Any], aside: float = 0.0) -> FigureScale:
        """Return a scale with zero in its middle, without `aside` per cent of the largest errors."""
        high = (_range([np.abs(error) for error in errors], aside) or (0.0, 0.0))[1] or 1.0
        return cls(-high, high, "RdBu_r", "error (grey levels)")

    @classmethod
    def positive(cls, high: float, label: str) -> FigureScale:
        """Return a scale from zero."""
        return cls(0.0, high or 1.0, "viridis", label)

    @classmethod
    def deviation(cls, *deviations: NDArray[Any], aside: float = 0.0) -> FigureScale:
        """Return the scale of standard deviations, without `aside` per cent of the largest."""
        return cls.positive((_range(deviations, aside) or (0.0, 0.0))[1], "standard deviation (grey levels)")


def _range(images: Iterable[NDArray[Any]], aside: float) -> tuple[float, float] | None:
    """Return the range of all images, each without `aside` per cent of its values at either end; None without any."""
    known = [image[np.isfinite(image)] for image in images]
    ends = [np.percentile(values, (aside, 100 - aside)) for values in known if values.size]
    return (float(min(low for low, _ in ends)), float(max(high for _, high in ends))) if ends else None


@dataclass(frozen=True)
class FigurePanel:
    """A map of a figure.

    place : row and column of its first pixel, and the side of its pixels, all in `unit`
    """

    title: str
    image: FloatArray
    scale: FigureScale
    unit: str = "target pixels"
    place: tuple[float, float, float] = (0.0, 0.0, 1.0)


def show_map(axes: Any, panel: FigurePanel, most: int = MOST_SHOWN) -> Any:
    """Draw the pixels of a panel, and return Matplotlib's image; of larger maps than `most` every n-th pixel."""
    (rows, columns), (row, column, side) = panel.image.shape, panel.place
    each = max(1, max(rows, columns) // most)
    return axes.imshow(
        panel.image[::each, ::each],
        cmap=panel.scale.colours,
        vmin=panel.scale.low,
        vmax=panel.scale.high,
        interpolation="nearest",
        extent=(column - 0.5, column - 0.5 + columns * side, row - 0.5 + rows * side, row - 0.5),
    )


def draw_panel(axes: Any, panel: FigurePanel, *, bar: bool = True) -> None:
    """Draw a panel with its title, with the numbers of rows and columns, and with a bar beside it, or room for one."""
    drawn = show_map(axes, panel)
    axes.set_title(panel.title, fontsize=10)
    axes.set_xlabel(f"column ({panel.unit})", fontsize=8)
    axes.set_ylabel(f"row ({panel.unit})", fontsize=8)
    axes.tick_params(labelsize=8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.get_major_locator().set_params(integer=True, nbins=4)
    if not bar:
        place = axes.get_position(original=True)
        axes.set_position((place.x0, place.y0, place.width * (1 - BAR - PAD), place.height))
        axes.set_anchor((1.0, 0.5))
        return
    drawn_bar = axes.figure.colorbar(drawn, ax=axes, fraction=BAR, pad=PAD)
    drawn_bar.set_label(panel.scale.label, fontsize=8)
    drawn_bar.ax.tick_params(labelsize=8)
