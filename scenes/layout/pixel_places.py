"""Positions of sensor pixels behind their lenses, computed for any of them, so that no array holds those of all."""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray

from ..camera import Camera
from ..lens_type import LensType
from ..pose import corner_offset, poses


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
        self._poses = [pose for _, _, pose in chosen]
        self._pitch = camera.pixel_pitch
        self._turned = camera.tolerance is not None or any(lens_type.is_rotated for lens_type in camera.types)

    @property
    def count(self) -> int:
        """Number of pixels."""
        return int(self._starts[-1])

    def numbers(self, pixels: IntArray) -> tuple[IntArray, IntArray]:
        """Return the number of each pixel within its sub-imager, and that of the sub-imager in the camera."""
        own = self._own(pixels)
        return pixels - self._starts[own], self._indices[own]

    def at(self, pixels: IntArray) -> FloatArray:
        """Return rows of (pixels,): x, y, z of each pixel's corner from its lens, x and y of the lens, and the axes.

        The axes of the patch, 6 rows, are there only where patches of the camera are tilted or rotated.
        """
        own = self._own(pixels)
        row, column = np.divmod(pixels - self._starts[own], self._columns[own])
        u = self._corners[own, 0] + column * self._pitch
        v = self._corners[own, 1] + row * self._pitch
        middles, axes = np.array([pose.middle for pose in self._poses]), np.array([pose.axes for pose in self._poses])
        lenses = np.array([pose.lens for pose in self._poses])
        if not self._turned:
            return np.stack([middles[own, 0] + u, middles[own, 1] + v, middles[own, 2], *lenses[own].T])
        corners = [middles[own, axis] + axes[own, axis, 0] * u + axes[own, axis, 1] * v for axis in range(3)]
        return np.stack([*corners, *lenses[own].T, *axes[own].reshape(-1, 6).T])

    def _own(self, pixels: IntArray) -> IntArray:
        return np.searchsorted(self._starts, pixels, side="right") - 1
