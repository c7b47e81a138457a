"""Positions of a sub-imager's pixels behind its lens, as designed or misaligned.

Lengths are millimetres, angles radians, relative to the centre of the lens: the sensor at z < 0, the target at z > 0. A
point of the sensor patch is (u, v) from its middle, u along its columns and v along its rows, both growing with x and
y; the image on the sensor is upside down, so that sub-images are upright.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.streams import Purpose, stream

from .camera import Camera
from .lens_type import LensType, SubImager
from .tables.camera import ToleranceTable


@dataclass(frozen=True)
class Misalignment:
    """Deviation of one sub-imager from its design.

    position : (x, y) of its lens;  tilt : of its patch about x and about y;  rotation : of its patch about the axis
    focal_length : relative, of the distance between lens and sensor
    """

    position: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    focal_length: float = 0.0


NO_MISALIGNMENT = Misalignment()


@dataclass(frozen=True)
class Pose:
    """Position of a lens and of its patch: the point (u, v) lies at `middle` + `axes` (u, v), (3,) and (3, 2)."""

    lens: tuple[float, float]
    middle: FloatArray
    axes: FloatArray


def pose_of(sub: SubImager, misalignment: Misalignment = NO_MISALIGNMENT) -> Pose:
    """The pose of a sub-imager, as designed unless a misalignment is given."""
    lens = sub.lens[0] + misalignment.position[0], sub.lens[1] + misalignment.position[1]
    depth = sub.depth * (1 + misalignment.focal_length)
    middle = np.array([sub.patch[0] - lens[0], sub.patch[1] - lens[1], -depth])
    (about_x, about_y), angle = misalignment.tilt, sub.rotation + misalignment.rotation
    tilted = np.array([[cos(about_y), sin(about_x) * sin(about_y)], [0.0, cos(about_x)]])
    rotated = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]]) @ tilted
    return Pose(lens, middle, np.vstack([rotated, [-sin(about_y), sin(about_x) * cos(about_y)]]))


def corner_offset(camera: Camera, sub: SubImager) -> tuple[float, float]:
    """(u, v) of the outer corner of a sub-imager's pixel (0, 0)."""
    rows, columns = sub.type.pixels
    return -columns / 2 * camera.pixel_pitch, -rows / 2 * camera.pixel_pitch


def pixel_middles(camera: Camera, sub: SubImager, pose: Pose) -> FloatArray:
    """Return the middles of a sub-imager's pixels from its lens: (rows, columns, 3)."""
    (left, top), (rows, columns) = corner_offset(camera, sub), sub.type.pixels
    u = (left + (np.arange(columns) + 0.5) * camera.pixel_pitch)[None, :, None]
    v = (top + (np.arange(rows) + 0.5) * camera.pixel_pitch)[:, None, None]
    return pose.middle + u * pose.axes[:, 0] + v * pose.axes[:, 1]


def misalignments(camera: Camera) -> tuple[Misalignment, ...]:
    """The misalignment of each sub-imager, drawn from the camera's tolerance.

    Deviations are normal; each sub-imager has a random stream of its own, so that it does not depend on the others.
    """
    if camera.tolerance is None:
        return (NO_MISALIGNMENT,) * len(camera.sub_imagers)
    return tuple(_draw(camera.tolerance, sub) for sub in camera.sub_imagers)


def _draw(tolerance: ToleranceTable, sub: SubImager) -> Misalignment:
    rng = stream(tolerance.seed, Purpose.TOLERANCE, sub.type.name, sub.k, sub.l)
    x, y, about_x, about_y, rotation, focal_length = (float(number) for number in rng.standard_normal(6))
    position, tilt = tolerance.position or 0.0, tolerance.tilt or 0.0
    return Misalignment(
        position=(x * position, y * position),
        tilt=(about_x * tilt, about_y * tilt),
        rotation=rotation * (tolerance.rotation or 0.0),
        focal_length=focal_length * (tolerance.focal_length or 0.0),
    )


def poses(camera: Camera) -> tuple[Pose, ...]:
    """The poses of all sub-imagers, misaligned as drawn, in the order of measurements."""
    pairs = zip(camera.sub_imagers, misalignments(camera), strict=True)
    return tuple(pose_of(sub, misalignment) for sub, misalignment in pairs)


class PixelPlaces:
    """Positions of the pixels of some adjacent lens types, by their number among these pixels."""

    def __init__(self, camera: Camera, types: tuple[LensType, ...]) -> None:
        """Collect what the pixels of a sub-imager have in common."""
        chosen = [
            (index, sub, pose)
            for index, (sub, pose) in enumerate(zip(camera.sub_imagers, poses(camera), strict=True))
            if sub.type in types
        ]
        sizes = [sub.type.pixels[0] * sub.type.pixels[1] for _, sub, _ in chosen]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._indices = np.array([index for index, _, _ in chosen])
        self._columns = np.array([sub.type.pixels[1] for _, sub, _ in chosen])
        self._corners = np.array([corner_offset(camera, sub) for _, sub, _ in chosen])
        self._middles = np.array([pose.middle for _, _, pose in chosen])
        self._axes = np.array([pose.axes for _, _, pose in chosen])
        self._lenses = np.array([pose.lens for _, _, pose in chosen])
        self._pitch = camera.pixel_pitch
        self._turned = camera.tolerance is not None or any(lens_type.is_rotated for lens_type in camera.types)

    def numbers(self, pixels: IntArray) -> tuple[IntArray, IntArray]:
        """Return the number of each of some ascending pixels within its sub-imager, and the latter's in the camera."""
        counts = self._counts(pixels)
        return pixels - np.repeat(self._starts[:-1], counts), np.repeat(self._indices, counts)

    def at(self, pixels: IntArray) -> FloatArray:
        """Return rows of (pixels,): x, y, z of each pixel's corner from its lens, x and y of the lens, and the axes.

        The axes of the patch, 6 rows, are there only where patches of the camera are tilted or rotated.
        pixels : ascending
        """
        counts = self._counts(pixels)
        row, column = np.divmod(pixels - np.repeat(self._starts[:-1], counts), np.repeat(self._columns, counts))
        u = np.repeat(self._corners[:, 0], counts) + column * self._pitch
        v = np.repeat(self._corners[:, 1], counts) + row * self._pitch
        (x, y, z), lenses = np.repeat(self._middles, counts, axis=0).T, np.repeat(self._lenses, counts, axis=0).T
        if not self._turned:
            return np.stack([x + u, y + v, z, *lenses])
        axes = np.repeat(self._axes.reshape(-1, 6), counts, axis=0).T
        corners = [at + axes[2 * axis] * u + axes[2 * axis + 1] * v for axis, at in enumerate((x, y, z))]
        return np.stack([*corners, *lenses, *axes])

    def _counts(self, pixels: IntArray) -> IntArray:
        """Return how many of some ascending pixels each sub-imager has."""
        return np.diff(np.searchsorted(pixels, self._starts))
