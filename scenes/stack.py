"""The recorded sub-images: one OpenEXR part each, with the variance of the rendering's mean.

Sub-images are upright: row 0 looks at the top of the target. Values are in the units of the target's pixels. Where the
scene has a [sensor], the file holds what that recorded, digital numbers and the means of dark and of flat frames, and
values follow from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError

from .camera import Camera, derive
from .formats import exr
from .formats.provenance import checked
from .recording import Recording
from .scene import Scene, parse

CHANNELS = ("Y", "variance")
OF_A_SENSOR = ("dark", "flat")
FLAT_VALUE = "flat_value"

STRAIGHT = "straight"  # in a record: light that bounces was left out, since nothing in the world reflects any


@dataclass(frozen=True)
class Stack:
    """All sub-images of one exposure: (M,) `values` and `variance` in the order of measurements.

    `record` says how they were made: samples, passes, seed, variant, seconds, versions, fingerprint.
    `recording` is what the scene's [sensor] told; `values` are then its own, NaN for dead pixels.
    """

    scene: Scene
    camera: Camera
    values: NDArray[np.float64]
    variance: NDArray[np.float64]
    record: dict[str, Any]
    recording: Recording | None = None

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
            recording=None if self.recording is None else self.recording.restrict(kept),
        )


def recorded(
    scene: Scene, camera: Camera, recording: Recording, variance: NDArray[np.float64], record: dict[str, Any]
) -> Stack:
    """The stack of what a sensor recorded; `variance`, (M,), of the rendering's mean."""
    return Stack(scene, camera, recording.values, variance, record, recording)


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
        if stack.recording is not None:
            record[FLAT_VALUE] = float(stack.recording.flat_value[place][0])
        channels = {
            name: pixels[place].reshape(sub.type.pixels).astype(np.float32) for name, pixels in _channels(stack).items()
        }
        parts.append(exr.Part(sub.name, channels, record))
    exr.write(path, parts)


def _channels(stack: Stack) -> dict[str, NDArray[np.float64]]:
    recording = stack.recording
    if recording is None:
        return {"Y": stack.values, "variance": stack.variance}
    return {"Y": recording.digital, "variance": stack.variance, "dark": recording.dark, "flat": recording.flat}


def read(path: Path) -> Stack:
    """Read a stack. Raises InputError if it is missing, cut short, altered or no stack."""
    parts = exr.read(path)
    first = parts[0].record
    if "scene" not in first or "record" not in first:
        raise InputError(f"{path}: expected a stack of sub-images, got another kind of OpenEXR file")
    try:
        record = checked(first["record"])
    except ValueError as error:
        raise InputError(f"{path}: {error}; make it again") from error
    scene = parse(first["scene"], path)
    camera = derive(scene)
    if [part.name for part in parts] != [sub.name for sub in camera.sub_imagers]:
        raise InputError(f"{path}: its parts are not the sub-images that its scene describes; make it again")
    names = CHANNELS if scene.sensor is None else CHANNELS + OF_A_SENSOR
    for part, sub in zip(parts, camera.sub_imagers, strict=True):
        shapes = {name: pixels.shape for name, pixels in part.channels.items()}
        if shapes != dict.fromkeys(names, sub.type.pixels):
            raise InputError(
                f"{path}: part '{part.name}' should hold {', '.join(names[:-1])} and {names[-1]} of"
                f" {sub.type.pixels}, got {shapes}"
            )
    variance = _flat(parts, "variance")
    if (variance < 0).any():
        raise InputError(f"{path}: holds variances below 0; make it again")
    if scene.sensor is None:
        return Stack(scene, camera, _flat(parts, "Y"), variance, record)
    digital, dark, flat = (_flat(parts, name) for name in ("Y", *OF_A_SENSOR))
    recording = Recording(scene.sensor, digital, dark, flat, _flat_values(path, parts))
    return recorded(scene, camera, recording, variance, record)


def _flat(parts: list[exr.Part], channel: str) -> NDArray[np.float64]:
    return np.concatenate([part.channels[channel].ravel() for part in parts]).astype(np.float64)


def _flat_values(path: Path, parts: list[exr.Part]) -> NDArray[np.float64]:
    numbers = [part.record.get(FLAT_VALUE) for part in parts]
    for part, number in zip(parts, numbers, strict=True):
        if not isinstance(number, float) or not 0 < number < inf:
            raise InputError(
                f"{path}: part '{part.name}' should say {FLAT_VALUE}, the target of its flat frames, a number above 0,"
                f" got {number!r}; make it again"
            )
    sizes = [part.channels["Y"].size for part in parts]
    return np.repeat(np.array(numbers, dtype=np.float64), sizes)
