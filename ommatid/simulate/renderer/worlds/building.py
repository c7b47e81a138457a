"""The checked text of a world as a scene of Mitsuba, and the surfaces of that scene that rays from the camera meet.

A world is built in the same way in a trial as in the process that renders.
"""

# pyright: basic
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable

from .placement import Placement

BLOCK = 4  # scalar variants seed by block, and derive its size from the number of threads unless it is given
MOST_SEGMENTS = 10_000  # of a path, before it may end at random: between white walls others never end
BACKWARDS = "ptracer"  # the integrator that starts at the emitters, and takes no block size


@dataclass(frozen=True)
class ParsedWorld:
    """A world as Mitsuba parsed it, without its sensors.

    sensors : properties of the sensors that it had;  has_integrator : True if it has one
    """

    config: Any
    state: Any
    sensors: list[Any]
    has_integrator: bool

    def build(self) -> Any:
        """Return Mitsuba's scene. Raises RuntimeError or TypeError where Mitsuba refuses it."""
        import mitsuba as mi

        return mi.parser.instantiate(self.config, self.state)


def parse_world(text: str, variant: str) -> ParsedWorld:
    """Parse the checked text of a world. Raises RuntimeError or TypeError where Mitsuba refuses it."""
    import mitsuba as mi

    config = mi.parser.ParserConfig(variant)
    state: Any = mi.parser.parse_string(config, text)
    root, resolved = state.root.props, mi.Properties.Type.ResolvedReference
    sensors, has_integrator = list[Any](), False
    for key in list(root.keys()):
        if root.type(key) == resolved:
            node = state.nodes[root[key].index()]
            has_integrator |= node.type == mi.ObjectType.Integrator
            if node.type == mi.ObjectType.Sensor:
                sensors.append(node.props)
                del root[key]
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator and node.props.plugin_name() != BACKWARDS:
            node.props["block_size"] = BLOCK
    mi.parser.transform_all(config, state)
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator:
            _check_lengths(node.props)
    return ParsedWorld(config, state, sensors, has_integrator)


def _check_lengths(integrator: Any) -> None:
    """Raise RuntimeError for an integrator whose paths may be endless: a max_depth below 0 is none."""
    most, sure = integrator.get("max_depth", -1), integrator.get("rr_depth", 5)
    if isinstance(most, int) and isinstance(sure, int) and min(sure, most if most >= 0 else sure) > MOST_SEGMENTS:
        raise RuntimeError(
            f"expected paths of at most {MOST_SEGMENTS} segments, got rr_depth {sure} and max_depth {most}; lower one"
        )


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
