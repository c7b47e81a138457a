"""The recorded sub-images: one OpenEXR part each, with the variance of the rendering's mean.

Sub-images are upright: row 0 looks at the top of the target. Values are in the units of the target's pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import exr
from .camera import Camera, derive
from .errors import InputError
from .scene import Scene, parse


@dataclass(frozen=True)
class Stack:
    """All sub-images of one exposure: (M,) `values` and `variance` in the order of measurements.

    `record` says how they were made: samples, passes, seed, variant, seconds, versions, fingerprint.
    """

    scene: Scene
    camera: Camera
    values: NDArray[np.float64]
    variance: NDArray[np.float64]
    record: dict[str, Any]

    def images(self) -> list[NDArray[np.float64]]:
        """One (rows, columns) array a sub-imager, in the order of the camera's."""
        pairs = zip(self.camera.sub_imagers, self.camera.slices(), strict=True)
        return [self.values[place].reshape(sub.type.pixels) for sub, place in pairs]

    def restrict(self, names: tuple[str, ...]) -> Stack:
        """Only the named lens types, in the stack's own order. Raises InputError for a name it does not have."""
        camera, kept = self.camera.restrict(names)
        lenses = tuple(lens for lens in self.scene.camera.lens if lens.name in names)
        update = {"camera": self.scene.camera.model_copy(update={"lens": lenses})}
        return replace(
            self,
            scene=self.scene.model_copy(update=update),
            camera=camera,
            values=self.values[kept],
            variance=self.variance[kept],
        )


def write(path: Path, stack: Stack) -> None:
    """Write the sub-images, float32. Raises InputError or DeniedError."""
    parts: list[exr.Part] = []
    for sub, place in zip(stack.camera.sub_imagers, stack.camera.slices(), strict=True):
        record: dict[str, Any] = {
            "type": sub.type.name,
            "k": sub.k,
            "l": sub.l,
            "magnification": str(1 / sub.type.ratio),
            "window": [str(sub.window[0]), str(sub.window[1])],
            "lens": list(sub.lens),
            "patch": list(sub.patch),
            "depth": sub.depth,
        }
        if not parts:
            record |= {"scene": stack.scene.plain(), "record": stack.record}
        channels = {
            "Y": stack.values[place].reshape(sub.type.pixels).astype(np.float32),
            "variance": stack.variance[place].reshape(sub.type.pixels).astype(np.float32),
        }
        parts.append(exr.Part(sub.name, channels, record))
    exr.write(path, parts)


def read(path: Path) -> Stack:
    """Read a stack. Raises InputError if it is missing, cut short, altered or no stack."""
    parts = exr.read(path)
    first = parts[0].record
    if "scene" not in first or "record" not in first:
        raise InputError(f"{path}: expected a stack of sub-images, got another kind of OpenEXR file")
    scene = parse(first["scene"], path)
    camera = derive(scene)
    if [part.name for part in parts] != [sub.name for sub in camera.sub_imagers]:
        raise InputError(f"{path}: its parts are not the sub-images that its scene describes; make it again")
    for part, sub in zip(parts, camera.sub_imagers, strict=True):
        shapes = {name: pixels.shape for name, pixels in part.channels.items()}
        if shapes != {"Y": sub.type.pixels, "variance": sub.type.pixels}:
            raise InputError(
                f"{path}: part '{part.name}' should hold Y and variance of {sub.type.pixels}, got {shapes}"
            )
    variance = _flat(parts, "variance")
    if (variance < 0).any():
        raise InputError(f"{path}: holds variances below 0; make it again")
    return Stack(
        scene=scene,
        camera=camera,
        values=_flat(parts, "Y"),
        variance=variance,
        record=first["record"],
    )


def _flat(parts: list[exr.Part], channel: str) -> NDArray[np.float64]:
    return np.concatenate([part.channels[channel].ravel() for part in parts]).astype(np.float64)
