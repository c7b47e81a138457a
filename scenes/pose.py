"""Where the pixels of a sub-imager stand behind its lens, in the camera as drawn or as it was put together.

Lengths are millimetres, angles radians, seen from the centre of the lens: the sensor at z < 0, the target at z > 0. A
point of the sensor patch is (u, v) from its middle, u along its columns and v along its rows, both growing with x and
y; the image on the sensor is upside down, so that sub-images are upright.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .lens_type import SubImager
from .tables.camera import ToleranceTable


@dataclass(frozen=True)
class Misalignment:
    """How one sub-imager stands and is beside its design.

    position : (x, y) of its lens;  tilt : of its patch about x and about y;  rotation : of its patch about the axis
    focal_length : relative, of the distance between lens and sensor
    """

    position: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    focal_length: float = 0.0


NONE = Misalignment()


@dataclass(frozen=True)
class Pose:
    """A sub-imager's lens, and where its patch is: the point (u, v) at `middle` + `axes` (u, v), (3,) and (3, 2)."""

    lens: tuple[float, float]
    middle: NDArray[np.float64]
    axes: NDArray[np.float64]


def pose_of(sub: SubImager, wrong: Misalignment = NONE) -> Pose:
    """The pose of a sub-imager that is misaligned so; as designed unless said."""
    lens = sub.lens[0] + wrong.position[0], sub.lens[1] + wrong.position[1]
    depth = sub.depth * (1 + wrong.focal_length)
    middle = np.array([sub.patch[0] - lens[0], sub.patch[1] - lens[1], -depth])
    (about_x, about_y), turn = wrong.tilt, wrong.rotation
    tilted = np.array([[cos(about_y), sin(about_x) * sin(about_y)], [0.0, cos(about_x)]])
    turned = np.array([[cos(turn), -sin(turn)], [sin(turn), cos(turn)]]) @ tilted
    return Pose(lens, middle, np.vstack([turned, [-sin(about_y), sin(about_x) * cos(about_y)]]))


def corner_offset(camera: Camera, sub: SubImager) -> tuple[float, float]:
    """(u, v) of the corner where pixel (0, 0) of a sub-imager begins."""
    rows, columns = sub.type.pixels
    return -columns / 2 * camera.pixel_pitch, -rows / 2 * camera.pixel_pitch


def misalignments(camera: Camera) -> tuple[Misalignment, ...]:
    """One for each sub-imager, as its tolerance draws them: normal, each sub-imager from a stream of its own."""
    if camera.tolerance is None:
        return (NONE,) * len(camera.sub_imagers)
    return tuple(_drawn(camera.tolerance, sub) for sub in camera.sub_imagers)


def _drawn(tolerance: ToleranceTable, sub: SubImager) -> Misalignment:
    key = zlib.crc32(f"tolerance {sub.type.name}".encode()), sub.k, sub.l
    rng = np.random.default_rng(np.random.SeedSequence(tolerance.seed, spawn_key=key))
    x, y, about_x, about_y, turn, longer = (float(number) for number in rng.standard_normal(6))
    position, tilt = tolerance.position or 0.0, tolerance.tilt or 0.0
    return Misalignment(
        position=(x * position, y * position),
        tilt=(about_x * tilt, about_y * tilt),
        rotation=turn * (tolerance.rotation or 0.0),
        focal_length=longer * (tolerance.focal_length or 0.0),
    )


def poses(camera: Camera) -> tuple[Pose, ...]:
    """Of every sub-imager as the camera was put together, in the order of measurements."""
    pairs = zip(camera.sub_imagers, misalignments(camera), strict=True)
    return tuple(pose_of(sub, wrong) for sub, wrong in pairs)
