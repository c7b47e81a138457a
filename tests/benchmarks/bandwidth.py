"""How near one application of H, and of its adjoint, comes to the speed at which memory can be read and written.

H must at least read f once for each lens type and write g once, and its adjoint read g and write f once. Both are set
against copies a = b and triads a = b + s c (McCalpin's STREAM, which counts two and three numbers for each of a), by
as many threads in the same run.
"""

# pyright: basic
from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.optics.boxes import BoxFootprints

from .alternation import alternate
from .whole import whole_camera

Vector = NDArray[np.float64]

SIZE = 4096
REPEATS = 7
BYTES = 8


@dataclass(frozen=True)
class BandwidthRow:
    """What was done, the bytes that it must move at least, and of every repeat the seconds and the limit in bytes/s."""

    name: str
    moved: int
    seconds: NDArray[np.float64]
    limit: NDArray[np.float64]

    @property
    def speed(self) -> float:
        """Bytes per second, from the median."""
        return self.moved / float(np.median(self.seconds))

    @property
    def share(self) -> float:
        """Of the limit, repeat by repeat: the median."""
        return float(np.median(self.moved / self.seconds / self.limit))


def bandwidth_rows() -> list[BandwidthRow]:
    """Copy, triad, H and its adjoint, in alternation; the limit is the faster of the first two."""
    camera = whole_camera(SIZE)
    boxes, rng = BoxFootprints(camera), np.random.default_rng(0)
    image, readings = rng.normal(size=camera.unknowns), rng.normal(size=camera.measurements)
    first, second, third = np.zeros(readings.size), np.ones(readings.size), np.ones(readings.size)
    ways = {
        "copy": (lambda _: _shared(_copy, first, second, third), 2 * readings.size),
        "triad": (lambda _: _shared(_triad, first, second, third), 3 * readings.size),
        "H f": (lambda _: boxes.forward(image), len(camera.types) * camera.unknowns + readings.size),
        "H^T g": (lambda _: boxes.adjoint(readings), readings.size + camera.unknowns),
    }
    for way, _ in ways.values():
        way(0)
    seconds = alternate([way for way, _ in ways.values()], REPEATS)
    moved = [BYTES * numbers for _, numbers in ways.values()]
    limit = np.maximum(moved[0] / seconds[0], moved[1] / seconds[1])
    return [BandwidthRow(name, moved[place], seconds[place], limit) for place, name in enumerate(ways)]


def _shared(work, *arrays: Vector) -> None:
    count = os.cpu_count() or 1
    pieces = zip(*(np.array_split(array, count) for array in arrays), strict=True)
    with ThreadPoolExecutor(count) as threads:
        for _ in threads.map(lambda piece: work(*piece), pieces):
            pass


@numba.njit(cache=True, nogil=True)
def _copy(first, second, third):  # noqa: ARG001
    for i in range(first.size):
        first[i] = second[i]


@numba.njit(cache=True, nogil=True)
def _triad(first, second, third):
    for i in range(first.size):
        first[i] = second[i] + 3.0 * third[i]
