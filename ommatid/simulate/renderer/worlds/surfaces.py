"""The surfaces of a Mitsuba scene that rays from the camera meet, and the box around all of them."""

# pyright: basic
from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable

from .placement import Placement


def check_positions(scene: Any, where: str) -> None:
    """Raise InputError for a surface that is somewhere infinite or nowhere, which rays would pass without a word."""
    for shape in scene.shapes():
        box = shape.bbox()
        ends = np.array([box.min, box.max], dtype=np.float64)
        if not np.isfinite(ends).all():
            raise InputError(
                f"{where}: expected surfaces at finite positions, got shape '{printable(shape.id(), 60)}' from"
                f" {_listed(ends.reshape(2, 3)[0])} to {_listed(ends.reshape(2, 3)[1])}; correct its numbers"
            )


def _listed(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def depths_met(scene: Any, placement: Placement, origins: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the distance along z, mm, of the surface that each ray meets first, (n,); infinite where it meets none.

    origins, directions : (n, 3) of the rays in the camera's coordinates
    """
    import mitsuba as mi

    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    starts, along = placement.to_file(origins), directions / lengths @ placement.axes.T
    if (mi.variant() or "").startswith("scalar"):
        rays = [mi.Ray3f(start, direction) for start, direction in zip(starts.tolist(), along.tolist(), strict=True)]
        met = np.array([scene.ray_intersect_preliminary(ray, coherent=False).t for ray in rays])
    else:
        start, direction = (np.ascontiguousarray(values.T, dtype=np.float32) for values in (starts, along))
        ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(direction))
        met = np.array(scene.ray_intersect_preliminary(ray, coherent=False).t, dtype=np.float64)
    return np.where(np.isfinite(met), met * placement.unit * directions[:, 2] / lengths[:, 0], np.inf)


def box_of(scene: Any, placement: Placement) -> FloatArray | None:
    """Return the box around all surfaces in the camera's coordinates, (2, 3): its least and largest x, y and z.

    It is the box around the file's own box, so that it may be larger where the camera is turned. None without surfaces.
    """
    if not scene.shapes():
        return None
    box = scene.bbox()
    ends = np.array([box.min, box.max], dtype=np.float64).reshape(2, 3)
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = placement.to_camera(corners)
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def has_surroundings(scene: Any) -> bool:
    """Return True if light comes from where there is no surface, as of a sky."""
    return scene.environment() is not None
