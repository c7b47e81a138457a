"""Memory traffic of H and its adjoint, relative to the bandwidth of memory.

H must at least read f once per lens type and write g once, and its adjoint read g and write f once. Both are compared
with copies a = b and triads a = b + s c (McCalpin's STREAM, which counts two and three numbers per element of a), with
as many threads in the same run.
"""

# pyright: basic
from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.optics.boxes import BoxFootprints

from .alternation import alternate
from .whole import whole_camera

SIZE = 4096
REPEATS = 7
BYTES = 8


@dataclass(frozen=True)
class BandwidthRow:
    """An operation, the bytes that it must at least move, and seconds and bandwidth (bytes/s) of every repeat."""

    name: str
    moved: int
    seconds: FloatArray
    limit: FloatArray

    @property
    def speed(self) -> float:
        """Bytes per second, from the median time."""
        return self.moved / float(np.median(self.seconds))

    @property
    def share(self) -> float:
        """Median of the fraction of the bandwidth over repeats."""
        return float(np.median(self.moved / self.seconds / self.limit))


def bandwidth_rows() -> list[BandwidthRow]:
    """Return copy, triad, H and its adjoint, in alternation; the bandwidth is that of the faster of the first two."""
    camera = whole_camera(SIZE)
    boxes, rng = BoxFootprints(camera), np.random.default_rng(0)
    image, readings = rng.normal(size=camera.unknowns), rng.normal(size=camera.measurements)
    first, second, third = np.zeros(readings.size), np.ones(readings.size), np.ones(readings.size)
    operations = {
        "copy": (lambda _: _run_threads(_copy, first, second, third), 2 * readings.size),
        "triad": (lambda _: _run_threads(_triad, first, second, third), 3 * readings.size),
        "H f": (lambda _: boxes.forward(image), len(camera.types) * camera.unknowns + readings.size),
        "H^T g": (lambda _: boxes.adjoint(readings), readings.size + camera.unknowns),
    }
    for run, _ in operations.values():
        run(0)
    seconds = alternate([run for run, _ in operations.values()], REPEATS)
    moved = [BYTES * numbers for _, numbers in operations.values()]
    limit = np.maximum(moved[0] / seconds[0], moved[1] / seconds[1])
    return [BandwidthRow(name, moved[index], seconds[index], limit) for index, name in enumerate(operations)]


def _run_threads(work, *arrays: FloatArray) -> None:
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
