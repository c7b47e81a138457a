"""The recorded sub-images, one part each of an OpenEXR file, with the variance of the rendered mean.

Sub-images are upright: row 0 looks at the top of the target. Values are in the units of the target's pixels. For a
scene with a [sensor] the file holds the recording, digital numbers and the means of dark and of flat frames, from which
values follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ommatid.runtime.arrays import FloatArray, as_numbers
from ommatid.runtime.errors import InputError, named, shortened, shortened_repr
from ommatid.runtime.versions import versions

from .camera import Camera, derive
from .formats import exr
from .formats.provenance import checked
from .lens_type import LensType, adjacent_slices
from .recording import Recording
from .scene import Scene, parse_stored, resolved
from .tables.table import LARGEST

CHANNELS = ("Y", "variance")
SENSOR_CHANNELS = ("dark", "flat")
FLAT_VALUE = "flat_value"
AGAIN = "make it again"

STRAIGHT = "straight"  # key of a record: interreflection was skipped, since nothing in the world reflects light


@dataclass(frozen=True)
class Stack:
    """All sub-images of one exposure: (M,) `values` and `rendering_variance` in the order of measurements.

    rendering_variance : of the rendered mean, without the sensor's noise; 0 where nothing was rendered
    record : how they were made: samples, passes, seed, variant, seconds, versions, fingerprint
    recording : of a scene with a [sensor]; `values` are then the recording's, NaN for dead pixels
    """

    scene: Scene
    camera: Camera
    values: FloatArray
    rendering_variance: FloatArray
    record: dict[str, Any]
    recording: Recording | None = None

    def __repr__(self) -> str:
        """Return title and size in one line."""
        title, count = shortened(self.scene.title), len(self.camera.sub_imagers)
        return f"<Stack '{title}': {count} sub-images, {self.values.size} measurements>"

    @property
    def variance(self) -> FloatArray:
        """Variance of the values, (M,): of the rendering, and of the sensor's noise and rounding."""
        return np.sum([self.rendering_variance, *self.sensor_noise().values()], axis=0)

    def sensor_noise(self, light: FloatArray | None = None) -> dict[str, FloatArray]:
        """Return the variances that the [noise] or [sensor] of the scene causes, (M,) each; absent effects have none.

        light : (M,) on the pixels, in units of f, absent: the readings near each pixel
        """
        if self.recording is not None:
            return self.recording.noise(self.recording.smoothed_light(self.camera) if light is None else light)
        table, noise = self.scene.noise, dict[str, FloatArray]()
        if table is not None and table.variance > 0:
            noise["noise"] = np.full(self.values.size, table.variance)
        if table is not None and table.bits is not None:
            noise["quantisation"] = np.full(self.values.size, table.quantisation_variance)
        return noise

    def images(self) -> list[FloatArray]:
        """The sub-images, (rows, columns) each, in the order of the camera's sub-imagers."""
        pairs = zip(self.camera.sub_imagers, self.camera.slices(), strict=True)
        return [self.values[pixels].reshape(sub.type.pixels) for sub, pixels in pairs]

    def arrays(self) -> dict[str, FloatArray]:
        """The sub-images by lens type: (rows, columns of the lens array, rows, columns of a sub-image) each."""
        pairs = zip(self.camera.types, self.camera.type_slices(), strict=True)
        return {lens.name: self.values[pixels].reshape(*lens.array, *lens.pixels) for lens, pixels in pairs}

    def restrict(self, names: tuple[str, ...]) -> Stack:
        """The stack of only the named lens types, in its own order. Raises InputError for an unknown name."""
        camera, mask = self.camera.restrict(names)
        lenses = tuple(lens for lens in self.scene.camera.lens if lens.name in names)
        update = {"camera": self.scene.camera.model_copy(update={"lens": lenses})}
        return replace(
            self,
            scene=self.scene.model_copy(update=update),
            camera=camera,
            values=self.values[mask],
            rendering_variance=self.rendering_variance[mask],
            recording=None if self.recording is None else self.recording.restrict(mask),
        )


def stack_from_arrays(scene: Scene, arrays: Mapping[str, ArrayLike]) -> Stack:
    """The stack of given sub-images, by lens type as `Stack.arrays` returns them; NaN marks dead pixels.

    Raises InputError for a scene with a [sensor], and for missing arrays, other names, shapes or infinite values.
    """
    if scene.sensor is not None:
        raise InputError(
            f"{scene.source}: a [sensor] needs dark and flat frames to convert its readings; convert them to values of"
            " f and describe their noise by [noise], or import files with `ommatid import`"
        )
    camera = derive(scene)
    if not isinstance(arrays, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise InputError(f"arrays: expected a dictionary by lens type, got {shortened_repr(arrays)}")
    names = [lens.name for lens in camera.types]
    if set(arrays) != set(names):
        expected, got = named(names, "'"), named(arrays, "'")
        raise InputError(f"arrays: expected one for each of the lens types {expected}, got {got}")
    values = np.concatenate([_checked(arrays[lens.name], lens).ravel() for lens in camera.types])
    record: dict[str, Any] = {"method": "imported", "seconds": 0.0, "versions": versions()}
    return Stack(resolved(scene, camera.shape), camera, values, np.zeros(values.size), record)


def _checked(given: ArrayLike, lens: LensType) -> FloatArray:
    """The sub-images of a lens type as numbers. Raises InputError."""
    array, expected = as_numbers(given, f"arrays['{lens.name}']"), (*lens.array, *lens.pixels)
    if array.shape != expected:
        raise InputError(
            f"arrays['{lens.name}']: expected {list(expected)}, rows and columns of the lens array and of a sub-image,"
            f" got {list(array.shape)}"
        )
    if not (np.isnan(array) | (np.abs(array) <= LARGEST**2)).all():
        raise InputError(
            f"arrays['{lens.name}']: expected numbers up to {LARGEST**2:g}, or NaN for dead pixels, got others"
        )
    return array


def write(path: Path, stack: Stack) -> None:
    """Write the sub-images as float32. Raises InputError or MachineError."""
    channels = {"Y": stack.values, "variance": stack.rendering_variance}
    if stack.recording is not None:
        channels |= {"Y": stack.recording.digital, "dark": stack.recording.dark, "flat": stack.recording.flat}
    _check_range(path, "make the target or its light darker", **channels)
    parts: list[exr.Part] = []
    for sub, pixels in zip(stack.camera.sub_imagers, stack.camera.slices(), strict=True):
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
            record[FLAT_VALUE] = float(stack.recording.flat_value[pixels][0])
        images = {name: values[pixels].reshape(sub.type.pixels).astype(np.float32) for name, values in channels.items()}
        parts.append(exr.Part(sub.name, images, record))
    exr.write(path, parts)


def read(path: Path) -> Stack:
    """Read a stack. Raises InputError if it is missing, cut short, altered or another kind of file."""
    parts = exr.read(path)
    scene, camera, record = _described(path, parts[0].record)
    if [part.name for part in parts] != [sub.name for sub in camera.sub_imagers]:
        raise InputError(f"{path}: its parts are not the sub-images that its scene describes; make it again")
    names = CHANNELS if scene.sensor is None else CHANNELS + SENSOR_CHANNELS
    for part, sub in zip(parts, camera.sub_imagers, strict=True):
        shapes = {name: pixels.shape for name, pixels in part.channels.items()}
        if shapes != dict.fromkeys(names, sub.type.pixels):
            raise InputError(
                f"{path}: part '{part.name}' should hold {', '.join(names[:-1])} and {names[-1]} of"
                f" {sub.type.pixels}, got {shapes}"
            )
    variance = _joined(parts, "variance")
    if not (variance >= 0).all():
        raise InputError(f"{path}: expected variances of 0 or more, got others; make it again")
    if scene.sensor is None:
        values = _joined(parts, "Y")
        _check_range(path, AGAIN, variance=variance, Y=values)
        return Stack(scene, camera, values, variance, record)
    sizes = [sub.type.pixels[0] * sub.type.pixels[1] for sub in camera.sub_imagers]
    digital, dark, flat = (_joined(parts, name) for name in ("Y", *SENSOR_CHANNELS))
    _check_range(path, AGAIN, variance=variance, Y=digital, dark=dark, flat=flat)
    recording = Recording(scene.sensor, digital, dark, flat, _flat_values(path, parts, sizes))
    return Stack(scene, camera, recording.values, variance, record, recording)


def read_header(path: Path) -> tuple[Scene, Camera]:
    """Read the scene and the camera of a stack without its pixels. Raises InputError as `read` does for these."""
    return _described(path, exr.read_first_record(path))[:2]


def _described(path: Path, first: dict[str, Any]) -> tuple[Scene, Camera, dict[str, Any]]:
    """Return scene, camera and record from the record of the first part."""
    if "scene" not in first or "record" not in first:
        raise InputError(f"{path}: expected a stack of sub-images, got another kind of OpenEXR file")
    try:
        record = checked(first["record"])
    except ValueError as error:
        raise InputError(f"{path}: {error}; make it again") from error
    scene = parse_stored(first["scene"], path)
    return scene, derive(scene), record


def _check_range(path: Path, cure: str, **channels: FloatArray) -> None:
    """Raise InputError for values that are infinite, or too large for their squares, with `cure`, the advice.

    NaN marks dead pixels in all channels but the variance.
    """
    for name, values in channels.items():
        values = values if name == "variance" else values[~np.isnan(values)]
        if values.size and not (values.min() >= -(LARGEST**2) and values.max() <= LARGEST**2):
            raise InputError(f"{path}: expected finite numbers up to {LARGEST**2:g} as {name}, got others; {cure}")


def _joined(parts: list[exr.Part], channel: str) -> FloatArray:
    sizes = [part.channels[channel].size for part in parts]
    joined = np.empty(sum(sizes))
    for part, pixels in zip(parts, adjacent_slices(sizes), strict=True):
        joined[pixels] = part.channels.pop(channel).ravel()  # released, so that no channel is held twice
    return joined


def _flat_values(path: Path, parts: list[exr.Part], sizes: list[int]) -> FloatArray:
    values = [part.record.get(FLAT_VALUE) for part in parts]
    for part, value in zip(parts, values, strict=True):
        if not isinstance(value, float) or not 0 < value < inf:
            raise InputError(
                f"{path}: part '{part.name}' should say {FLAT_VALUE}, the value of the flat frames' target, a number"
                f" above 0, got {value!r}; make it again"
            )
    return np.repeat(np.array(values, dtype=np.float64), sizes)
