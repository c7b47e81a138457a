"""Maps of truth, estimate, error and posterior standard deviation with shared ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import Float32Array
from ommatid.scenes.constants import WHITE

from . import plots
from .data import ResultMaps
from .plots import ColourScale

UNIT = "pixel value (0 to 255)"
SHOWN = 99.5  # per cent of the pixels that a colour scale distinguishes; a few outliers would take all of its range


@dataclass(frozen=True)
class Panel:
    """A map with its colour scale and its description in words."""

    name: str
    title: str
    image: Float32Array
    colours: ColourScale
    words: str


def panels(maps: ResultMaps) -> list[Panel]:
    """Return the panels in order; truth and error only if the truth is known."""
    shown: list[Panel] = []
    if maps.truth is None:
        grey = ColourScale(plots.GREY, *_range(maps.estimate, (100 - SHOWN) / 2), UNIT)
    else:
        grey = ColourScale(plots.GREY, *_range(maps.truth, 0.0), UNIT)
        shown.append(Panel("truth", "Truth", maps.truth, grey, value_words(maps.truth)))
    shown.append(Panel("estimate", "Estimate", maps.estimate, grey, value_words(maps.estimate)))
    if maps.error is not None:
        limit = _limit(np.abs(maps.error))
        colours = ColourScale(plots.DIVERGING, -limit, limit, "estimate minus truth")
        shown.append(Panel("error", "Error", maps.error, colours, _error_words(maps.error, limit)))
    colours = ColourScale(plots.SEQUENTIAL, 0.0, _limit(maps.deviation), "posterior standard deviation")
    return [*shown, Panel("deviation", "Standard deviation", maps.deviation, colours, value_words(maps.deviation))]


def figures(maps: ResultMaps, shown: list[Panel]) -> list[Any]:
    """Return a figure per panel, with one source and one pair of ranges, so that they move together.

    The errors are zero in the source: the page computes them from the other maps when it is opened.
    """
    columns = {panel.name: [np.ascontiguousarray(panel.image)] for panel in shown}
    if "error" in columns:
        columns["error"] = [np.zeros_like(columns["error"][0])]
    data = plots.source(columns, "maps")
    view = plots.view(0, maps.columns, 0, maps.rows)
    tips = [("row", "$y{0}"), ("column", "$x{0}")]
    tips += [(panel.title.lower(), f"@{panel.name}{{%.5g}}") for panel in shown]
    # The target's edge may cut the last blocks, but Bokeh draws all pixels in one size.
    rows, columns_shown = shown[0].image.shape
    area = 0, 0, columns_shown * maps.block, rows * maps.block
    return [
        plots.map_figure(panel.name, data, panel.name, panel.colours, view, tips, area=area, formatted=tuple(columns))
        for panel in shown
    ]


def value_words(image: NDArray[Any]) -> str:
    """Return smallest, largest and mean value, and the number of missing values, in words."""
    known = image[np.isfinite(image)]
    if not known.size:
        return "no value is known"
    missing = image.size - known.size
    words = f"range {known.min():.4g} to {known.max():.4g}, mean {known.mean(dtype=np.float64):.4g}"
    return words + (f"; {missing} of {image.size} are missing" if missing else "")


def _error_words(error: Float32Array, limit: float) -> str:
    squares = np.square(error, dtype=np.float64)
    outside = int(np.sum(np.abs(error) > limit))
    words = f"RMS {float(np.sqrt(np.nanmean(squares))):.3g}, largest {float(np.nanmax(np.abs(error))):.3g}"
    return words + (f"; {outside} outside the colour scale, which ends at ±{limit:.3g}" if outside else "")


def _range(image: Float32Array, aside: float) -> tuple[float, float]:
    """Return the range of an image without `aside` per cent of the values at either end."""
    known = image[np.isfinite(image)]
    if not known.size:
        return 0.0, WHITE
    low, high = (float(end) for end in np.percentile(known, [aside, 100 - aside]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _limit(image: Float32Array) -> float:
    known = image[np.isfinite(image)]
    return (float(np.percentile(known, SHOWN)) if known.size else 0.0) or 1.0
