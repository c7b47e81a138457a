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
        self._middles = np.array([pose.middle for _, _, pose in chosen])
        self._axes = np.array([pose.axes for _, _, pose in chosen])
        self._lenses = np.array([pose.lens for _, _, pose in chosen])
        self._pitch = camera.pixel_pitch
        self._turned = camera.tolerance is not None or any(lens_type.is_rotated for lens_type in camera.types)

    @property
    def count(self) -> int:
        """Number of pixels."""
        return int(self._starts[-1])

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
