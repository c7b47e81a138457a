"""Lens prescriptions and their paraxial properties.

Lengths are millimetres. Positions along the axis are counted from the first vertex and grow towards the sensor, in the
order of the surfaces; a radius is positive if its centre lies towards the sensor. The lens is in air. Paraxial rays are
(y, n u), height and angle times index, so that a surface of power P = (n' - n) / radius is the matrix [[1, 0], [-P, 1]]
and a gap of thickness t is [[1, t / n], [0, 1]] (E. Hecht, Optics, section 6.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from ..constants import GREEN
from ..tables import glass
from ..tables.camera import Surface


class Pupil(NamedTuple):
    """An image of the aperture stop: its position on the axis, and its radius."""

    position: float
    radius: float


@dataclass(frozen=True, eq=False)
class Prescription:
    """The surfaces of a lens, all arrays (surfaces,), in the order in which light from the target meets them.

    radius : of curvature, infinite if flat;  thickness : to the next surface, 0 for the last one
    index : of refraction behind each;  semi_diameter : of its opening;  conic : 0 a sphere, -1 a paraboloid
    stop : index of the aperture stop
    aspheric : for each surface a4, a6, ... of the sag a4 r^4 + a6 r^6 + ... added to that of the conic, empty for a
        conic, in mm^-3, mm^-5, ...; absent: all are conics
    """

    radius: FloatArray
    thickness: FloatArray
    index: FloatArray
    semi_diameter: FloatArray
    conic: FloatArray
    stop: int
    aspheric: tuple[tuple[float, ...], ...] = ()

    def scaled(self, factor: float) -> Prescription:
        """Return the lens with all its lengths times a factor."""
        return replace(
            self,
            radius=self.radius * factor,
            thickness=self.thickness * factor,
            semi_diameter=self.semi_diameter * factor,
            aspheric=tuple(
                # A factor whose power is 0 in float64 is too small for any ray.
                tuple(term / max(factor**power, 1e-300) for power, term in zip(range(3, 16, 2), row, strict=False))
                for row in self.aspheric
            ),
        )

    @cached_property
    def index_before(self) -> FloatArray:
        """Index of refraction in front of each surface."""
        return np.append(1.0, self.index[:-1])

    @cached_property
    def vertices(self) -> FloatArray:
        """Positions of the surfaces on the axis."""
        return np.append(0.0, np.cumsum(self.thickness[:-1]))

    def sag(self, height: float) -> FloatArray:
        """Return the sag of each surface, towards the sensor, at a height above the axis, or at its edge if lower."""
        lower = np.minimum(height, self.semi_diameter)
        square = lower**2 / self.radius
        sag = square / (1 + np.sqrt(np.maximum(1 - (1 + self.conic) * square / self.radius, 0.0)))
        if not self.aspheric:
            return sag
        shares = (lower / self.semi_diameter).tolist()
        rows = zip(self.rim_sags(), shares, strict=True)
        return sag + np.array([sum(term * share ** (4 + 2 * n) for n, term in enumerate(row)) for row, share in rows])

    def rim_sags(self) -> tuple[tuple[float, ...], ...]:
        """Return for each surface the sag at the rim that each of its aspheric terms adds, from r^4 on."""
        rows = self.aspheric or ((),) * self.radius.size
        return tuple(
            tuple(term * rim**power for power, term in zip(range(4, 17, 2), row, strict=False))
            for row, rim in zip(rows, self.semi_diameter.tolist(), strict=True)
        )

    def last_extent(self) -> tuple[float, float]:
        """Return the least and the largest sag of the last surface, towards the sensor, 0 at its vertex."""
        heights = self.semi_diameter[-1] * np.linspace(0, 1, 65) if self.aspheric and self.aspheric[-1] else [inf]
        sags = [0.0, *(float(self.sag(height)[-1]) for height in heights)]
        return min(sags), max(sags)

    def matrix(self, first: int, last: int) -> FloatArray:
        """Return the ray matrix, (2, 2), from before surface `first` to before surface `last`, or behind the lens."""
        power = (self.index - self.index_before) / self.radius
        matrix = np.eye(2)
        for surface in range(first, last):
            gap = self.thickness[surface] / self.index[surface]
            matrix = np.array([[1.0, gap], [0.0, 1.0]]) @ np.array([[1.0, 0.0], [-power[surface], 1.0]]) @ matrix
        return matrix

    @cached_property
    def _whole(self) -> FloatArray:
        return self.matrix(0, self.radius.size)

    @property
    def focal_length(self) -> float:
        """The focal length in air, negative for a diverging lens. Raises InputError if it is afocal."""
        power = -self._whole[1, 0]
        if abs(power) <= 1e-12 * np.sum(np.abs((self.index - self.index_before) / self.radius)):
            raise InputError("the surfaces are afocal: they have no focal length and form no image; bend one of them")
        return float(1 / power)

    @property
    def front_principal(self) -> float:
        """Position of the plane from which the target's distance counts."""
        return float((1 - self._whole[1, 1]) * self.focal_length)

    @property
    def rear_principal(self) -> float:
        """Position of the plane from which the sensor's distance counts."""
        return float(self.vertices[-1] + (self._whole[0, 0] - 1) * self.focal_length)

    @property
    def entrance_pupil(self) -> Pupil:
        """The stop seen from the target; infinitely far and wide for a lens that is telecentric there."""
        (across, tilted), _ = self.matrix(0, self.stop)
        if abs(across) < 1e-12:
            return Pupil(inf, inf)
        return Pupil(float(tilted / across), float(self.semi_diameter[self.stop] / abs(across)))

    @property
    def exit_pupil(self) -> Pupil:
        """The stop seen from the sensor; infinitely far and wide for a lens that is telecentric there."""
        (_, tilted), (_, angle) = self.matrix(self.stop, self.radius.size)
        if abs(angle) < 1e-12:
            return Pupil(inf, inf)
        position = self.vertices[-1] - tilted / angle
        return Pupil(float(position), float(self.semi_diameter[self.stop] / abs(angle)))

    def working_f_number(self, depth: float) -> float:
        """Return the f-number of the cone of light at a sensor `depth` behind the rear principal plane."""
        # The ray from the stop's rim to the sensor's axis leaves the last surface with the slope -radius / (B + s D).
        (_, tilted), (_, angle) = self.matrix(self.stop, self.radius.size)
        behind = depth + self.rear_principal - self.vertices[-1]
        return float(abs(tilted + behind * angle) / (2 * self.semi_diameter[self.stop]))


def prescribe(surfaces: Sequence[Surface], wavelength: float | None = None) -> Prescription:
    """Create the prescription of a list of surfaces at a wavelength, 550 nm unless given.

    Without a marked stop it is the surface that limits the bundle of a far point on the axis. Raises InputError for
    two stops, an unknown glass, and a lens whose back is not in air.
    """
    marked = [index for index, surface in enumerate(surfaces) if surface.stop]
    if len(marked) > 1:
        raise InputError(f"expected one aperture stop at most, got {len(marked)}; mark the smallest alone")
    index = [glass.index_behind(surface, wavelength or GREEN) for surface in surfaces]
    if index[-1] != 1:
        raise InputError(
            f"expected air behind the last surface, got an index of {index[-1]:g}; end the list with the surface"
            " where the light leaves the glass"
        )
    aspheric = tuple(surface.aspheric or () for surface in surfaces)
    lens = Prescription(
        radius=np.array([surface.radius or inf for surface in surfaces]),
        thickness=np.array([surface.thickness or 0.0 for surface in surfaces[:-1]] + [0.0]),
        index=np.array(index),
        semi_diameter=np.array([surface.semi_diameter for surface in surfaces]),
        conic=np.array([surface.conic for surface in surfaces]),
        stop=marked[0] if marked else 0,
        aspheric=aspheric if any(aspheric) else (),
    )
    if marked:
        return lens
    heights = np.array([abs(lens.matrix(0, surface)[0, 0]) for surface in range(len(surfaces))])
    return replace(lens, stop=int(np.argmin(lens.semi_diameter / np.maximum(heights, 1e-30))))
