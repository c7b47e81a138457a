"""Lenses of surfaces for the tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.prescription import Prescription
from ommatid.scenes.scene import parse, read

from .examples import GALLERY

# A double Gauss lens of 50 mm, f/2, after United States patent 2673491 (Tronnier, 1954).
DOUBLE_GAUSS = """# f/2
50
29.475   3.76   1.67   25.2
84.83    0.12   1      25.2   # air
19.275   4.025  1.67   23
40.77    3.275  1.699  23

12.75    5.705  1      18
0        4.5    0      17.1
-14.495  1.18   1.603  17
40.77    6.065  1.658  20
-20.385  0.19   1      20
437.065  3.22   1.717  20
-39.73   36.77  1      20
"""

BICONVEX = [
    {"radius": "1 mm", "thickness": "0.2 mm", "glass": "N-BK7", "semi_diameter": "0.15 mm", "stop": True},
    {"radius": "-1 mm", "semi_diameter": "0.2 mm"},
]


# So thin that closed forms of thin lenses hold, at f/13.
THIN = [
    {"radius": "2 mm", "thickness": "1 um", "index": 1.5, "semi_diameter": "75 um"},
    {"radius": "-2 mm", "semi_diameter": "75 um"},
]


def lens(
    radius: list[float],
    thickness: list[float],
    index: list[float],
    semi_diameter: float | list[float] = 1.0,
    conic: list[float] | None = None,
    stop: int = 0,
) -> Prescription:
    """Create a lens from numbers; the thickness of the last surface is omitted."""
    count = len(radius)
    return Prescription(
        radius=np.array(radius),
        thickness=np.append(thickness, 0.0),
        index=np.array(index),
        semi_diameter=np.broadcast_to(np.array(semi_diameter), count),
        conic=np.zeros(count) if conic is None else np.array(conic),
        stop=stop,
    )


def ball(radius: float = 1.0, index: float = 1.5) -> Prescription:
    """Create a ball lens."""
    return lens([radius, -radius], [2 * radius], [index, 1.0], radius)


def camera_with(surfaces: Any, changes: Sequence[str] = (), **more: Any) -> Camera:
    """Return the camera of the paper's tile, with changes, with these lenses of type I, and room for them."""
    data = read(GALLERY / "tile19.toml", changes, ["I"]).plain()
    data["camera"]["lens"][0] |= {"surfaces": surfaces, **more}
    data["camera"]["lens_pitch"] = "1 mm"
    return derive(parse(data, Path("test.toml")))


def turned_round(lens: Prescription) -> Prescription:
    """Return a lens whose surfaces are in reverse order."""
    return Prescription(
        radius=-lens.radius[::-1],
        thickness=np.append(lens.thickness[-2::-1], 0.0),
        index=lens.index_before[::-1],
        semi_diameter=lens.semi_diameter[::-1],
        conic=lens.conic[::-1],
        stop=lens.radius.size - 1 - lens.stop,
        aspheric=tuple(tuple(-term for term in row) for row in lens.aspheric[::-1]),
    )
