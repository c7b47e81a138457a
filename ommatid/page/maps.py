"""Truth, estimate, error and posterior deviation side by side, on ranges that they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.constants import WHITE

from . import plots
from .data import Image, ResultMaps
from .plots import Colours

UNIT = "value (0 to 255)"
SHOWN = 99.5  # per cent of the pixels whose colours a scale tells apart; a few at the edges would grey out the others


@dataclass(frozen=True)
class Panel:
    """A map, how it is coloured, and what is said of it."""

    name: str
    title: str
    image: Image
    colours: Colours
    words: str


def panels(maps: ResultMaps) -> list[Panel]:
    """What there is to see, in order: truth and error only where the truth is known."""
    grey = Colours(plots.GREY, *_ends(maps.estimate if maps.truth is None else maps.truth, maps.truth is None), UNIT)
    spread = _most(maps.deviation)
    found: list[Panel] = []
    if maps.truth is not None:
        found.append(Panel("truth", "Truth", maps.truth, grey, values_in_words(maps.truth)))
    found.append(Panel("estimate", "Estimate", maps.estimate, grey, values_in_words(maps.estimate)))
    if maps.error is not None:
        size = _most(np.abs(maps.error))
        colours = Colours(plots.DIVERGING, -size, size, "estimate minus truth")
        found.append(Panel("error", "Error", maps.error, colours, _error_in_words(maps.error, size)))
    colours = Colours(plots.SEQUENTIAL, 0.0, spread, "standard deviation")
    words = values_in_words(maps.deviation)
    found.append(Panel("deviation", "Posterior deviation", maps.deviation, colours, words))
    return found


def figures(maps: ResultMaps, shown: list[Panel]) -> list[Any]:
    """A figure a panel: one source and one pair of ranges, so that they move together and know each other's values.

    The errors' column is left empty, for the page computes it from the others where it is read.
    """
    columns = {panel.name: [np.ascontiguousarray(panel.image)] for panel in shown}
    if "error" in columns:
        columns["error"] = [np.zeros_like(columns["error"][0])]
    data = plots.source(columns, "maps")
    view = plots.view(0, maps.columns, 0, maps.rows)
    tips = [("row", "$y{0}"), ("column", "$x{0}")]
    tips += [(panel.title.lower(), f"@{panel.name}{{%.5g}}") for panel in shown]
    formatters = {f"@{panel.name}": "printf" for panel in shown}
    # The last blocks may be cut by the edge, and Bokeh's pixels are all of one size.
    places = 0, 0, shown[0].image.shape[1] * maps.block, shown[0].image.shape[0] * maps.block
    return [
        plots.map_figure(panel.name, data, panel.name, panel.colours, view, tips, places=places, formatters=formatters)
        for panel in shown
    ]


def values_in_words(image: NDArray[Any]) -> str:
    """Smallest, largest and mean value, and how many are missing."""
    known = image[np.isfinite(image)]
    if not known.size:
        return "no value is known"
    missing = image.size - known.size
    told = f"values from {known.min():.4g} to {known.max():.4g}, mean {known.mean(dtype=np.float64):.4g}"
    return told + (f"; {missing} of {image.size} are missing" if missing else "")


def _error_in_words(error: Image, size: float) -> str:
    squares = np.square(error, dtype=np.float64)
    beyond = int(np.sum(np.abs(error) > size))
    told = f"rms {float(np.sqrt(np.nanmean(squares))):.3g}, largest {float(np.nanmax(np.abs(error))):.3g}"
    return told + (f"; colours end at {size:.3g}, {beyond} lie beyond" if beyond else "")


def _ends(image: Image, doubtful: bool) -> tuple[float, float]:
    """The range of a picture; of one that may have gone astray in places without its outermost values."""
    known = image[np.isfinite(image)]
    if not known.size:
        return 0.0, WHITE
    aside = (100 - SHOWN) / 2 if doubtful else 0.0
    low, high = (float(end) for end in np.percentile(known, [aside, 100 - aside]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _most(image: Image) -> float:
    known = image[np.isfinite(image)]
    found = float(np.percentile(known, SHOWN)) if known.size else 0.0
    return found or 1.0
