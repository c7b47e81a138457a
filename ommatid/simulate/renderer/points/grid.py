"""Points on a grid over a sensor pixel, one per cell, by random numbers that depend on the pixel and its key alone.

Mitsuba's samplers number their streams within all rays that start together, so that the rays of a sub-imager would
depend on which others start with it. These do not, and sub-imagers are rendered together.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

BITS = 24  # of a random number: a float32 has as many
ROUNDS = 4  # of the Tiny Encryption Algorithm, after which its numbers pass statistical tests (Zafar et al. 2010)


@dataclass(frozen=True)
class Grid:
    """`cells` x `cells` cells over a pixel; points keep a `margin`, relative to the cell's side, to its edges."""

    cells: int
    margin: float

    def position(self, lane: Any, key: Any, number: Any) -> Any:
        """Return a point in [0, 1)^2 for each lane, whose adjacent ones are the cells of one pixel, by rows.

        key : of the pixel's sub-imager and pass;  number : of the pixel in its sub-imager
        """
        import drjit as dr
        import mitsuba as mi

        cells = dr.opaque(mi.UInt32, self.cells)
        cell = lane % (cells * cells)
        row, first = cell // cells, mi.sample_tea_32(number, key, ROUNDS)
        draws = mi.sample_tea_32(first[0] + cell, first[1], ROUNDS)
        u, v = (mi.Float(draw >> (32 - BITS)) * 2.0**-BITS for draw in draws)
        margin, free = dr.opaque(mi.Float, self.margin), dr.opaque(mi.Float, 1 - 2 * self.margin)
        inverse: Any = dr.opaque(mi.Float, 1 / self.cells)
        column = cell - row * cells
        return mi.Point2f((column + margin + free * u) * inverse, (row + margin + free * v) * inverse)
