"""Regions of a frame that no reading sees, as where all of them are saturated, in a preconditioner.

There K is P0^-1 alone, and C what the prior leaves open where its surroundings are known: about P0 of waves that are
shorter than the distance from the nearest pixel that is seen, and nothing of longer ones, which the readings around
tell. So C is about that of a frame with all of its readings, plus for each octave of waves

    T P T,   T = sin(pi d / 2 l) up to d = l, and 1 beyond,

where P is the prior's spectrum in the octave, l its wavelength, and d the distance from a pixel that is seen. Steps
depend on the border of the regions then, and not on their area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.machine import processors

from .conjugate_gradients import FrameSystem, Preconditioner

HIGHEST = 0.5**0.5  # periods per pixel of the shortest waves, along a diagonal
LEAST = 0.3  # of T, below which the surroundings of all regions tell an octave


@dataclass(frozen=True)
class WithUnseen:
    """A preconditioner of a frame with all of its readings, and the octaves (T, P) of what some regions lack.

    T, P : (rows, columns) each, of the pixels and of the waves under the DCT-II
    """

    seen: Preconditioner
    octaves: tuple[tuple[FloatArray, FloatArray], ...]

    def solve(self, image: FloatArray, waves: FloatArray | None = None) -> FloatArray:
        """Return about C b: (rows, columns) to (rows, columns); waves : those of b where they are known."""
        solved = self.seen.solve(image, waves)
        for taper, spectrum in self.octaves:
            part = fft.dctn(taper * image, 2, norm="ortho", workers=processors())
            part *= spectrum
            solved += taper * fft.idctn(part, 2, norm="ortho", workers=processors(), overwrite_x=True)
        return solved


def with_unseen(system: FrameSystem, seen: Preconditioner) -> Preconditioner:
    """Return a preconditioner for a system some of whose pixels no used reading sees; `seen` itself without any."""
    unseen = system.unseen
    if not unseen.any():
        return seen
    if isinstance(system.prior, float):
        return WithUnseen(seen, ((unseen.astype(np.float64), np.full(system.shape, 1 / system.prior)),))
    return WithUnseen(seen, tuple(_octaves(unseen, 1 / np.asarray(system.prior))))


def _octaves(unseen: BoolArray, spectrum: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    rows, columns = unseen.shape
    down, across = np.linspace(0, 0.5, rows, endpoint=False), np.linspace(0, 0.5, columns, endpoint=False)
    frequency = np.hypot(down[:, None], across)
    distance = ndimage.distance_transform_edt(unseen) if not unseen.all() else np.full(unseen.shape, np.inf)
    octaves: list[tuple[FloatArray, FloatArray]] = []
    high, lowest = HIGHEST, 0.5 / max(unseen.shape)
    while high > lowest:
        low = high / 2 if high / 2 > lowest else -1.0
        wavelength = 1 / (HIGHEST * high)  # in the middle of the octave
        taper = np.sin(np.pi / 2 * np.minimum(distance / wavelength, 1.0))
        if taper.max() > LEAST:
            octaves.append((taper, np.where((frequency <= high) & (frequency > low), spectrum, 0.0)))
        high /= 2
    return octaves
