"""Rays from the sensor through a thin lens that diffracts, on Mitsuba's fast backends.

A ray leaves in the direction in which the diffraction pattern of the defocused pupil has light at the distance of what
the ray meets. Before a flat target this is a displacement of the ray through the lens's centre. In a world a ray starts
from a point of the pupil; the ray of geometrical optics from there finds the surface's distance, and the ray goes to
the point of the pattern there that encircles as much light as the pupil's point does. Far out of focus the two are the
same, and at any distance the light of all rays is the pattern's. (Where a surface ends before another, the pattern on
either is not exact.)
"""

# pyright: basic
from __future__ import annotations

from functools import lru_cache
from math import ceil, log, pi
from typing import Any

import numpy as np

from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.optics.diffraction import QUANTILES, pattern
from ommatid.scenes.optics.field import vergence_shifts

from .lens import Distance, Emission, LensModel, Point, drawn_bands, falloff, through_thin_lens
from .loaded import dr, mi

FEW_QUANTILES = 2**12  # where the defocus varies
STEP, GROWTH, LINEAR = 0.05, 1.02, 3.0  # between tabulated defoci, in waves: up to LINEAR, and as a factor beyond
MOST_TABULATED = 20.0  # waves, beyond which the radii grow with the defocus
SAME = 1e-3  # waves by which defocus may vary without a table of several
BEYOND = 1 - 1e-5  # focus over distance beyond the focus: below 1, since a side that rounding decides is no random one
TINY = 1e-6  # share of the light that lands within a million times the largest radius
NEAR = 10.0  # apertures: surfaces that are nearer get the pattern of that distance
# Share of the light nearer to the chief ray, cosine and sine of the direction about it, and the pupil's slant along it.
Beam = tuple[Any, Any, Any, Any]


class DiffractingLens(LensModel):
    """A thin lens with an aperture, in focus or not, for light of one or several wavelengths."""

    has_weights = True

    def __init__(self, camera: Camera, lens_type: LensType, aperture: float) -> None:
        """Create the model of a lens type with an aperture of this diameter."""
        super().__init__(camera, lens_type)
        self.distance: Distance | None = None
        self._camera, self._type, self._aperture = camera, lens_type, aperture
        self._depth, self._focus = camera.depth(lens_type), camera.focus(lens_type)
        self._weight = (aperture / (2 * self._depth)) ** 2
        self._wavelengths, self._shares = zip(*camera.wavelengths, strict=True)
        self._shifts = vergence_shifts(camera, lens_type)
        self._tabulate([1 / camera.distance_of(lens_type) + shift for shift in self._shifts])

    def follow(self, distance: Distance) -> None:
        """Let rays have the pattern of the distance of the surface that they meet."""
        self.distance = distance
        self._tabulate([1 / (NEAR * self._aperture) + self._shifts[1], self._shifts[0]])
        self.captured = 1.0  # rays go where the rest of the light lands, too

    def _waves(self, vergence: Any, wavelength: float) -> Any:
        return self._aperture**2 / (8 * wavelength) * (vergence - 1 / self._focus)

    def _tabulate(self, vergences: list[float]) -> None:
        """Tabulate the patterns of all bands between vergences of the light that meets the sensor."""
        ends = np.array(
            [[self._waves(vergence, wavelength) for vergence in vergences] for wavelength in self._wavelengths]
        )
        self._steps = QUANTILES if np.ptp(ends, axis=1).max() < SAME else FEW_QUANTILES
        self._tables = [BandTable(wavelengths, self._weight, self._steps) for wavelengths in ends]
        self.captured = float(np.average([table.captured for table in self._tables], weights=self._shares))

    def emit(self, x: Any, y: Any, depth: Any, sampler: Any, lens: Point) -> Emission:
        """Return origins and directions, from the lens's centre, of rays from (x, y, -depth), and weights."""
        sample = sampler.next_2d()
        bands, share, light = drawn_bands(self._shares, sampler), sample.x, falloff(x, y, 0.0, 0.0, depth)
        if self.spreads and self.captured < 1:  # the light beyond a ring falls as 1 / radius: as many rays to each
            beyond = dr.exp(sample.x * log(1 - self.captured))
            share, light = (1 - beyond) / self.captured, light * beyond
        sine, cosine = dr.sincos(2 * pi * sample.y)
        chief = self.chief(x, y, depth)
        beam = share, cosine, sine, 2 * (x * cosine + y * sine) * (self._aperture / 2) / (depth * depth)
        shift = 1 / depth - 1 / self._depth
        if self.distance is None:
            slopes, slant = self._displaced(chief, 1 / self._camera.distance_of(self._type) + shift, beam, bands)
            return (0, 0, 0), (*slopes, 1), light * slant
        rim = dr.sqrt(share / (1 + self._weight * (1 - share))) * self._aperture / 2
        start = rim * cosine, rim * sine
        focal = 1 / (1 / self._depth + 1 / self._focus)
        direction = [through_thin_lens(c, a, depth, focal) for c, a in zip(chief, start, strict=True)]
        vergence = 1 / self.distance((lens[0] + start[0], lens[1] + start[1], 0), (*direction, 1))
        slopes, slant = self._displaced(chief, vergence + shift, beam, bands)
        direction = [slope - a * vergence for slope, a in zip(slopes, start, strict=True)]
        return (*start, 0), (*direction, 1), light * slant

    def _displaced(self, chief: Point, vergence: Any, beam: Beam, bands: list[Any]) -> tuple[Point, Any]:
        """Return the slopes, from the lens's centre, to the points that rays meet, and their relative weights."""
        share, cosine, sine, slope = beam
        along: Any = 0.0
        slant: Any = 1.0
        for wavelength, table, later in zip(self._wavelengths, self._tables, bands, strict=True):
            waves = dr.abs(self._waves(vergence, wavelength))
            v, relative = table.at(waves, share, all_light=self.distance is not None)
            along = dr.select(later, v * (wavelength / (pi * self._aperture)), along)
            slant = dr.select(later, 1 + slope * relative, slant)
        along = dr.select(vergence * self._focus < BEYOND, -along, along)
        return (chief[0] + along * cosine, chief[1] + along * sine), slant


class BandTable:
    """Radii v and relative slants of one wavelength's patterns by defocus and by the root of the share of light."""

    def __init__(self, ends: FloatArray, weight: float, steps: int) -> None:
        """Tabulate the patterns between the least and the largest of some defoci, in waves, in so many steps."""
        low, high = (0.0, np.abs(ends).max()) if ends.min() < 0 < ends.max() else np.sort(np.abs(ends))
        limited = min(low, MOST_TABULATED / GROWTH), min(high, MOST_TABULATED)
        self._nodes = _nodes(*limited) if high - low >= SAME else np.array([(low + high) / 2])
        self._steps = steps
        tables, self.captured = _radii_and_slants(tuple(self._nodes.tolist()), weight, steps)
        self._radii, self._slants = (mi.Float(table) for table in tables)
        self._waves = mi.Float(self._nodes.astype(np.float32))

    def at(self, waves: Any, share: Any, all_light: bool) -> tuple[Any, Any]:
        """Return v and the relative slant where a share of the light is nearer, of that in the table or of all light.

        Beyond the last defocus the radii grow as those of the disk of rays, beyond the table's as those of its tail.
        """
        if not all_light:
            return self._inside(waves, share)
        v, slant = self._inside(waves, dr.minimum(share / self.captured, 1.0))
        rest = (1 - self.captured) / dr.maximum(1 - share, TINY)
        return v * dr.maximum(rest, 1.0), slant

    def _inside(self, waves: Any, share: Any) -> tuple[Any, Any]:
        position = dr.sqrt(share) * self._steps
        cell = dr.minimum(mi.UInt32(position), self._steps - 1)
        inside = position - mi.Float(cell)
        if self._nodes.size == 1:
            return tuple(self._between(table, cell, inside) for table in (self._radii, self._slants))
        limited = dr.clip(waves, float(self._nodes[0]), float(self._nodes[-1]))
        node = dr.binary_search(0, self._nodes.size - 2, lambda i: dr.gather(mi.Float, self._waves, i + 1) < limited)
        first, last = (dr.gather(mi.Float, self._waves, node + i) for i in (0, 1))
        share = (limited - first) / (last - first)
        row = node * (self._steps + 1) + cell
        v, slant = (
            dr.lerp(self._between(table, row, inside), self._between(table, row + self._steps + 1, inside), share)
            for table in (self._radii, self._slants)
        )
        return v * dr.maximum(waves / float(self._nodes[-1]), 1.0), slant

    @staticmethod
    def _between(table: Any, row: Any, share: Any) -> Any:
        return dr.lerp(dr.gather(mi.Float, table, row), dr.gather(mi.Float, table, row + 1), share)


@lru_cache(maxsize=16)
def _radii_and_slants(nodes: tuple[float, ...], weight: float, steps: int) -> tuple[list[Float32Array], float]:
    """Return the tables of radii and of slants, (defoci times (steps + 1),) each, and the share of light inside."""
    patterns = [pattern(waves, weight) for waves in nodes]
    radii = [each.quantiles(steps) for each in patterns]
    slants = [each.relative_slant(v) for each, v in zip(patterns, radii, strict=True)]
    tables = [np.concatenate(table).astype(np.float32) for table in (radii, slants)]
    return tables, float(np.mean([each.encircled for each in patterns]))


def _nodes(low: float, high: float) -> FloatArray:
    """Return the tabulated defoci, which include both ends: (n,)."""
    linear = (
        np.linspace(low, min(high, LINEAR), max(2, ceil((min(high, LINEAR) - low) / STEP) + 1)) if low < LINEAR else []
    )
    first = max(low, LINEAR)
    count = ceil(np.log(high / first) / np.log(GROWTH)) + 1 if high > first else 0
    return np.unique(np.concatenate([linear, np.geomspace(first, high, max(count, 2)) if count else []]))
