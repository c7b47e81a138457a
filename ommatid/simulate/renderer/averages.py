"""Averages of the picture over the boxes that sensor pixels throw on the target, so that only the blur is sampled.

Behind a thin lens the rays of one point of the pupil, from all of a sensor pixel, meet a box of m x m pixels of f,
which the point displaces. The average of a picture of even pixels over a box of whole ones is bilinear in the
displacement between those of whole pixels. So rays from the pixel's middle meet the averages by bilinear interpolation,
and what is left to chance is the point spread alone. A ratio p / q takes a picture of q x q times as many pixels.

The light of a pixel's corners falls off by other angles: to first order the first moments of the boxes show it. Through
a pinhole nothing is left to chance.
"""

# pyright: basic
from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

from .loaded import dr, mi


class Averages:
    """A picture's averages and first moments over the boxes of a lens type; dark beside the target."""

    def __init__(self, camera: Camera, lens_type: LensType, picture: FloatArray) -> None:
        """Average a picture, (rows, columns), in the units of radiance."""
        self._camera = camera
        self._boxes, self._parts = zip(*(side.as_integer_ratio() for side in lens_type.footprint), strict=True)
        fine: FloatArray = np.repeat(np.repeat(picture, self._parts[0], axis=0), self._parts[1], axis=1)
        means = [np.full(box, 1 / box) for box in self._boxes]
        moments = [((np.arange(box) + 0.5) / box - 0.5) / box for box in self._boxes]
        down, offset_down = (_over_boxes(fine, weights[0]) for weights in (means, moments))
        layers = [_over_boxes(lines.T, means[1]).T for lines in (down, offset_down)]
        layers.append(_over_boxes(down.T, moments[1]).T)
        self._shape = layers[0].shape
        data = np.ascontiguousarray(np.stack(layers, axis=-1), dtype=np.float32)
        texture: Any = mi.Texture2f
        modes = {"filter_mode": dr.FilterMode.Linear, "wrap_mode": dr.WrapMode.Clamp}
        # Texture units of a GPU know the place between two averages to 1/256 only.
        self._texture = texture(mi.TensorXf(data), use_accel=False, **modes)

    def light(self, ray: Any, falloff: tuple[Any, Any] = (0.0, 0.0), moved: tuple[float, float] = (0.0, 0.0)) -> Any:
        """Return the radiance that the pixels of rays from their middles meet.

        falloff : relative change of the light's weight across a pixel, down and across, of each ray
        moved : displacement of the boxes, down and across, in parts of a pixel of the picture
        """
        camera, along = self._camera, (self._camera.distance - ray.o.z) / ray.d.z
        middle = [camera.rows / 2 - (ray.o.y + along * ray.d.y) / camera.target_pitch]
        middle.append(camera.columns / 2 - (ray.o.x + along * ray.d.x) / camera.target_pitch)
        v, u = (
            (parts * each + box / 2 + 0.5 + by) / size
            for parts, box, each, by, size in zip(self._parts, self._boxes, middle, moved, self._shape, strict=True)
        )
        mean, down, across = self._texture.eval(mi.Point2f(u, v))
        return mean + falloff[0] * down + falloff[1] * across


def _over_boxes(lines: FloatArray, weights: FloatArray) -> FloatArray:
    """Return weighted sums over adjacent lines, from those before the first to those behind the last; 0 beside them."""
    beside = weights.size
    padded = np.pad(lines, ((beside, beside), (0, 0)))
    count = lines.shape[0] + beside + 1
    return sum((weight * padded[start : start + count] for start, weight in enumerate(weights)), np.zeros(1))
