"""Where the camera stands in the coordinates of a Mitsuba file.

The file stays as it is, so that lamps, media and textures keep their meaning: rays are carried from the camera, whose
lengths are millimetres, into the file's coordinates, and distances back.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.tables.world import WorldTable, is_similarity

FINEST = 100  # per pixel of the target: how finely float32 has to resolve the camera's position


@dataclass(frozen=True, eq=False)
class Placement:
    """The camera's pose in a file.

    axes : (3, 3) orthogonal, whose columns are the camera's x, y and z, in the file's coordinates
    origin : (3,) of the camera, in the file's coordinates
    unit : millimetres per length of the file
    """

    axes: FloatArray
    origin: FloatArray
    unit: float

    @classmethod
    def of_table(cls, table: WorldTable) -> Placement:
        """Return the pose that a [world] states, by its unit, scale and to_world."""
        if table.to_world is None:
            return cls(np.eye(3), np.zeros(3), table.unit_length)
        matrix = np.array(table.to_world).reshape(4, 4)
        factor, axes = _factor_and_axes(matrix[:3, :3].T)
        # p_mm = unit (factor axes^T scale p + t) is zero at the camera
        origin = -axes @ matrix[:3, 3] / (factor * table.scale)
        return cls(axes, origin, factor * table.unit_length)

    @classmethod
    def of_sensor(cls, to_world: FloatArray, table: WorldTable) -> Placement | None:
        """Return the pose of a file's sensor, from its (4, 4) transform; None if that is sheared or stretched."""
        if not is_similarity(to_world[:3, :3]) or not np.array_equal(to_world[3], [0, 0, 0, 1]):
            return None
        return cls(_factor_and_axes(to_world[:3, :3])[1], to_world[:3, 3], table.unit_length)

    @property
    def is_identity(self) -> bool:
        """True if the file's coordinates are the camera's."""
        return self.unit == 1 and np.array_equal(self.axes, np.eye(3)) and not self.origin.any()

    @property
    def spacing(self) -> float:
        """Millimetres between neighbouring positions of the camera in float32."""
        return float(np.spacing(np.float32(np.abs(self.origin).max()))) * self.unit

    def to_camera(self, points: FloatArray) -> FloatArray:
        """Return points, (n, 3), of the file in the camera's coordinates."""
        return (points - self.origin) @ self.axes * self.unit

    def to_file(self, points: FloatArray) -> FloatArray:
        """Return points, (n, 3), before the camera in the file's coordinates."""
        return points @ self.axes.T / self.unit + self.origin

    def carry(self, origin: Any, direction: Any) -> tuple[Any, Any]:
        """Return origins and directions of rays in the file's coordinates, on the fast backends.

        Directions keep their lengths.
        """
        if self.is_identity:
            return origin, direction
        import drjit as dr
        import mitsuba as mi

        def rotated(matrix: FloatArray, vector: Any) -> list[Any]:
            rows = [[dr.opaque(mi.Float, number) for number in row] for row in matrix.tolist()]
            return [x * vector.x + y * vector.y + z * vector.z for x, y, z in rows]

        start = rotated(self.axes / self.unit, origin)
        offset = [dr.opaque(mi.Float, number) for number in self.origin.tolist()]
        return mi.Point3f(*start) + mi.Point3f(*offset), mi.Vector3f(*rotated(self.axes, direction))

    def to_world(self, transform: Any, rigid: bool = False) -> Any:
        """Return Mitsuba's transform, of what stands before the camera, in the file's coordinates.

        rigid : True for a sensor, whose position is carried and whose size is not
        """
        if self.is_identity:
            return transform
        import mitsuba as mi

        matrix: FloatArray = np.array(transform.matrix, dtype=np.float64)
        placed: Any = np.eye(4)
        placed[:3, :3] = self.axes @ matrix[:3, :3] / (1 if rigid else self.unit)
        placed[:3, 3] = self.to_file(matrix[None, :3, 3])[0]
        return mi.ScalarTransform4f(placed)


def _factor_and_axes(linear: FloatArray) -> tuple[float, FloatArray]:
    """Return the factor and the orthogonal matrix of a similarity."""
    left, values, right = np.linalg.svd(linear)
    return float(values.mean()), np.asarray(left @ right)


MILLIMETRES_AT_ORIGIN = Placement(np.eye(3), np.zeros(3), 1.0)
