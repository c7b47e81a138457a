"""Arrays in a page: compressed, as text, with the palettes by which the page's program draws them."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

LEVEL = 6  # of the compression: 9 takes twice the time for a hundredth of the size
# Colours at equal distances, between which the program interpolates: viridis and the reversed RdBu of Matplotlib.
PALETTES: dict[str, tuple[str, ...]] = {
    "grey": ("#000000", "#ffffff"),
    "sequential": (
        "#440154", "#48186a", "#472d7b", "#424086", "#3b528b", "#33638d", "#2c728e", "#26828e", "#21918c",
        "#1fa088", "#28ae80", "#3fbc73", "#5ec962", "#84d44b", "#addc30", "#d8e219", "#fde725",
    ),
    "diverging": (
        "#053061", "#15508d", "#2870b1", "#3e8cbf", "#68abd0", "#98c8e0", "#c0dceb", "#deebf2", "#f6f7f7",
        "#fbe6da", "#fbceb7", "#f5ac8b", "#e58368", "#d25849", "#bb2a34", "#960f27", "#67001f",
    ),
}  # fmt: skip
MISSING_COLOUR = "#d81b60"  # of pixels without a value: in none of the palettes


@dataclass(frozen=True)
class ColourScale:
    """The name of a palette, the values at its ends, and the name of the quantity."""

    palette: str
    low: float
    high: float
    unit: str

    @property
    def gradient(self) -> str:
        """The palette as a CSS gradient, for the legend of a map."""
        return f"linear-gradient(90deg, {', '.join(PALETTES[self.palette])})"

    def plain(self) -> dict[str, Any]:
        """Return the scale in JSON's types."""
        return {"palette": self.palette, "low": self.low, "high": self.high, "unit": self.unit}


def encoded(values: NDArray[Any]) -> dict[str, Any]:
    """Return type and shape of an array, and its little-endian bytes, compressed by gzip, as base64 text."""
    array = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    compressed = gzip.compress(array.tobytes(), LEVEL, mtime=0)
    return {"dtype": values.dtype.name, "shape": list(values.shape), "data": base64.b64encode(compressed).decode()}


def decoded(content: Mapping[str, Any]) -> NDArray[Any]:
    """Return the array of `encoded`."""
    values = gzip.decompress(base64.b64decode(content["data"]))
    return np.frombuffer(values, dtype=np.dtype(content["dtype"]).newbyteorder("<")).reshape(content["shape"])


def document(groups: Sequence[Mapping[str, Any]]) -> Markup:
    """Return groups of maps that move together as JSON that can stand in HTML, with the palettes."""
    content = {"palettes": PALETTES, "missing": MISSING_COLOUR, "groups": list(groups)}
    return Markup(json.dumps(content, allow_nan=False).replace("<", "\\u003c"))
