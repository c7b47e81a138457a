"""A real lens as numbers, and what the paraxial theory says of it.

Lengths are millimetres. Positions along the axis are counted from the first vertex and grow towards the sensor, in the
order of the surfaces; a radius is positive where its centre lies towards the sensor. The lens stands in air. Paraxial
rays are (y, n u), height and angle times index, so that a surface of power P = (n' - n) / radius is the matrix
[[1, 0], [-P, 1]] and a gap of thickness t is [[1, t / n], [0, 1]] (E. Hecht, Optics, section 6.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import GREEN
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.tables import glass
from ommatid.scenes.tables.camera import Surface

Array = NDArray[np.float64]


class Pupil(NamedTuple):
    """An image of the aperture stop: where it lies on the axis, and its radius."""

    position: float
    radius: float


@dataclass(frozen=True, eq=False)
class Prescription:
    """The surfaces of a lens, all arrays (surfaces,), in the order in which light from the target meets them.

    radius : of curvature, infinite where flat;  thickness : to the next surface, of the last one 0
    index : of refraction behind each;  semi_diameter : of its opening;  conic : 0 a sphere, -1 a paraboloid
    stop : the place in the list of the aperture stop
    """

    radius: Array
    thickness: Array
    index: Array
    semi_diameter: Array
    conic: Array
    stop: int

    def scaled(self, factor: float) -> Prescription:
        """The lens with all its lengths times a factor."""
        return replace(
            self,
            radius=self.radius * factor,
            thickness=self.thickness * factor,
            semi_diameter=self.semi_diameter * factor,
        )

    def reversed(self) -> Prescription:
        """The lens turned round."""
        return Prescription(
            radius=-self.radius[::-1],
            thickness=np.append(self.thickness[-2::-1], 0.0),
            index=self.index_before[::-1],
            semi_diameter=self.semi_diameter[::-1],
            conic=self.conic[::-1],
            stop=self.radius.size - 1 - self.stop,
        )

    @cached_property
    def index_before(self) -> Array:
        """Index of refraction in front of each surface."""
        return np.append(1.0, self.index[:-1])

    @cached_property
    def vertices(self) -> Array:
        """Where the surfaces cross the axis."""
        return np.append(0.0, np.cumsum(self.thickness[:-1]))

    def sag(self, height: float) -> Array:
        """How far towards the sensor each surface has moved at a height above the axis, or at its edge if lower."""
        square = np.minimum(height, self.semi_diameter) ** 2 / self.radius
        return square / (1 + np.sqrt(np.maximum(1 - (1 + self.conic) * square / self.radius, 0.0)))

    def matrix(self, first: int, last: int) -> Array:
        """(2, 2): from before surface `first` to before surface `last`, which may be one past the end."""
        power = (self.index - self.index_before) / self.radius
        found = np.eye(2)
        for place in range(first, last):
            gap = self.thickness[place] / self.index[place]
            found = np.array([[1.0, gap], [0.0, 1.0]]) @ np.array([[1.0, 0.0], [-power[place], 1.0]]) @ found
        return found

    @cached_property
    def _whole(self) -> Array:
        return self.matrix(0, self.radius.size)

    @property
    def focal_length(self) -> float:
        """In air; negative of a lens that spreads light. Raises InputError if it is afocal."""
        power = -self._whole[1, 0]
        if abs(power) <= 1e-12 * np.sum(np.abs((self.index - self.index_before) / self.radius)):
            raise InputError("the surfaces are afocal: they have no focal length and show no image; bend one of them")
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
        """The stop seen from the target; infinitely far and wide where the lens is telecentric there."""
        (across, tilted), _ = self.matrix(0, self.stop)
        if abs(across) < 1e-12:
            return Pupil(inf, inf)
        return Pupil(float(tilted / across), float(self.semi_diameter[self.stop] / abs(across)))

    @property
    def exit_pupil(self) -> Pupil:
        """The stop seen from the sensor; infinitely far and wide where the lens is telecentric there."""
        (_, tilted), (_, angle) = self.matrix(self.stop, self.radius.size)
        if abs(angle) < 1e-12:
            return Pupil(inf, inf)
        position = self.vertices[-1] - tilted / angle
        return Pupil(float(position), float(self.semi_diameter[self.stop] / abs(angle)))

    @property
    def f_number(self) -> float:
        """Focal length over the diameter of the entrance pupil."""
        return self.focal_length / (2 * self.entrance_pupil.radius)

    def working_f_number(self, depth: float) -> float:
        """Of the cone of light that the stop lets through to a sensor so far behind the rear principal plane."""
        # The ray from the stop's rim to the sensor's axis leaves the last surface with the slope -radius / (B + s D).
        (_, tilted), (_, angle) = self.matrix(self.stop, self.radius.size)
        behind = depth + self.rear_principal - self.vertices[-1]
        return float(abs(tilted + behind * angle) / (2 * self.semi_diameter[self.stop]))

    def image_distance(self, distance: float) -> float:
        """From the rear principal plane to the image of what is so far before the front one; negative: virtual."""
        vergence = 1 / self.focal_length - 1 / distance
        return inf if vergence == 0 else 1 / vergence


def prescribe(surfaces: Sequence[Surface], wavelength: float | None = None) -> Prescription:
    """The numbers of a list of surfaces at a wavelength, 550 nm unless given.

    Without a marked stop it is the surface that limits the bundle of a far point on the axis. Raises InputError for
    two stops, an unknown glass, and a lens whose back is not in air.
    """
    marked = [place for place, surface in enumerate(surfaces) if surface.stop]
    if len(marked) > 1:
        raise InputError(f"expected one aperture stop at most, got {len(marked)}; mark the smallest alone")
    index = [surface.index or glass.index(surface.glass or glass.AIR, wavelength or GREEN) for surface in surfaces]
    if index[-1] != 1:
        raise InputError(
            f"expected air behind the last surface, got an index of {index[-1]:g}; end the list with the surface"
            " where the light leaves the glass"
        )
    found = Prescription(
        radius=np.array([surface.radius or inf for surface in surfaces]),
        thickness=np.array([surface.thickness or 0.0 for surface in surfaces[:-1]] + [0.0]),
        index=np.array(index),
        semi_diameter=np.array([surface.semi_diameter for surface in surfaces]),
        conic=np.array([surface.conic for surface in surfaces]),
        stop=marked[0] if marked else 0,
    )
    if marked:
        return found
    heights = np.array([abs(found.matrix(0, place)[0, 0]) for place in range(len(surfaces))])
    return replace(found, stop=int(np.argmin(found.semi_diameter / np.maximum(heights, 1e-30))))


def prescription_of(camera: Camera, kind: LensType) -> Prescription:
    """The surfaces of a lens type at the camera's wavelength, scaled as it asks for.

    With scale "fit", or none, the focal length is `camera.focal_length`. The front principal plane is the plane of the
    lenses; the sensor stands `camera.depth` behind the rear one, so that the magnification is the type's. Raises
    InputError if the lens type has no surfaces or these cannot show an image there.
    """
    key = f"camera.lens.{kind.name}.surfaces"
    if kind.optics.surfaces is None:
        raise InputError(f"{key}: expected a list of surfaces or a lens file, got none")
    try:
        found = prescribe(kind.optics.surfaces, camera.wavelength)
        focal_length = found.focal_length
    except InputError as error:
        raise InputError(f"{key}: {error}") from error
    if focal_length < 0:
        raise InputError(
            f"{key}: expected a lens that collects light, got a focal length of {focal_length:.4g} mm; check the signs"
            " of the radii: positive where the centre lies towards the sensor"
        )
    scale = kind.optics.scale
    placed = found.scaled(scale if isinstance(scale, float | int) else camera.focal_length(kind) / focal_length)
    edge = placed.vertices[-1] + max(0.0, float(placed.sag(inf)[-1]))
    room = placed.rear_principal + camera.depth(kind) - edge
    if room <= 0:
        raise InputError(
            f"{key}: the sensor would stand {-room:.4g} mm inside the lens, {camera.depth(kind):.4g} mm behind its rear"
            " principal plane; turn the lens round, make it thinner or scale it"
        )
    return placed
