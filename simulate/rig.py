"""The camera and its target in Mitsuba: a picture on the target goes in, what every sensor pixel reads comes out.

On llvm and cuda one sensor of our own holds the whole camera; on scalar, where sensors written in Python are
unusably slow, a stock `perspective` sensor a sub-imager does. (A stock `batch` is no faster there, and gives now and
then a ray to the wrong sub-imager: film coordinates are float32 and can round up to the next one's.) Lengths are
millimetres.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from math import atan, degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.camera import Camera, LensType, SubImager

from . import optics
from .variant import activate

BLOCK = 4  # scalar variants seed by block, and pick its size by the number of threads unless it is given


class Rig:
    """A camera in front of an emissive target, ready to be exposed.

    `groups` are the lens types that are exposed at once, by a name: the whole camera where that can be and is wanted
    (`together`), else each lens type by itself. `channels` is how many pictures can be on the target at once, as its
    colours.
    """

    def __init__(self, camera: Camera, variant: str, sampler: str = "multijitter", together: bool = True) -> None:
        """Build the Mitsuba scene; the target is black until `show` puts a picture on it."""
        activate(variant)
        import mitsuba as mi

        self.camera = camera
        self._jit = not variant.startswith("scalar")
        self.groups: dict[str, tuple[LensType, ...]] = {kind.name: (kind,) for kind in camera.types}
        if self._jit and together:
            self.groups = {"camera": camera.types}
        self.channels = 3 if variant.endswith("rgb") else 1
        self._sensors: dict[str, dict[int, Any]] = {
            group: self._sensors_of(group, types, sampler) for group, types in self.groups.items()
        }
        self._scene = mi.load_dict(scene_of(target_of(camera, self._black())))
        self._parameters = mi.traverse(self._scene)

    def show(self, *images: NDArray[np.float64]) -> None:
        """Put pictures, (rows, columns), at most `channels` of them, on the target; signed values are allowed."""
        import mitsuba as mi

        texels = np.zeros((self.camera.rows, self.camera.columns, self.channels), dtype=np.float32)
        for channel, image in enumerate(images):
            texels[..., channel] = image
        self._parameters["target.emitter.radiance.data"] = mi.TensorXf(texels)
        self._parameters.update()

    def expose(self, group: str, samples: int, seed: Callable[[int], int]) -> NDArray[np.float64]:
        """What the sensor pixels of a group read of each picture, (channels, pixels in the order of measurements).

        samples : rays a pixel, at most a few thousand, since the renderer's sums are float32
        seed : the sampler's seed by the place of a sensor: of a group where a group is one sensor, else a sub-imager
        """
        import mitsuba as mi

        images: list[NDArray[np.float64]] = []
        for place, sensor in self._sensors[group].items():
            rendered: Any = mi.render(self._scene, sensor=sensor, spp=samples, seed=seed(place))  # pyright: ignore
            images.append(np.moveaxis(np.array(rendered, dtype=np.float64), -1, 0).reshape(self.channels, -1))
        return np.concatenate(images, axis=1)[:, : sum(kind.measurements for kind in self.groups[group])]

    def _sensors_of(self, group: str, types: tuple[LensType, ...], sampler: str) -> dict[int, Any]:
        import mitsuba as mi

        if self._jit:
            return {list(self.groups).index(group): _one_sensor(self.camera, types, sampler)}
        return {
            place: mi.load_dict(stock_sensor(self.camera, sub, sampler, 16, self.channels))
            for place, sub in enumerate(self.camera.sub_imagers)
            if sub.type in types
        }

    def _black(self) -> dict[str, Any]:
        import mitsuba as mi

        texels = np.zeros((self.camera.rows, self.camera.columns, self.channels), dtype=np.float32)
        return texture_of({"bitmap": mi.Bitmap(texels)})

    def places(self, group: str) -> slice:
        """Where a group's pixels stand among all measurements."""
        start = 0
        for kind in self.camera.types:
            if kind in self.groups[group]:
                return slice(start, start + sum(member.measurements for member in self.groups[group]))
            start += kind.measurements
        raise KeyError(group)


def scene_of(target: dict[str, Any]) -> dict[str, Any]:
    """A Mitsuba scene with the emissive target and no sensor: light goes straight, nothing bounces."""
    return {"type": "scene", "integrator": {"type": "path", "max_depth": 1, "block_size": BLOCK}, "target": target}


def target_of(camera: Camera, texture: dict[str, Any]) -> dict[str, Any]:
    """The rectangle that the picture is on, seen from the front, upright, one texel a pixel of f."""
    import mitsuba as mi

    half = [camera.columns * camera.target_pitch / 2, camera.rows * camera.target_pitch / 2, 1.0]
    place = mi.ScalarTransform4f().translate([0, 0, camera.distance]).rotate([0, 1, 0], 180).scale(half)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}


def stock_sensor(camera: Camera, sub: SubImager, sampler: str, samples: int, channels: int = 1) -> dict[str, Any]:
    """One sub-imager as Mitsuba's own `perspective` with a shifted principal point."""
    import mitsuba as mi

    rows, columns = sub.type.pixels
    width = float(sub.type.ratio) * columns * camera.target_pitch
    height = float(sub.type.ratio) * rows * camera.target_pitch
    x, y = camera.position(*sub.type.middle(sub.window))
    lens_x, lens_y = sub.lens
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": 2 * degrees(atan(width / 2 / camera.distance)),
        "near_clip": camera.distance * 1e-3,
        "far_clip": camera.distance * 2,
        "principal_point_offset_x": -(x - lens_x) / width,
        "principal_point_offset_y": -(y - lens_y) / height,
        "to_world": mi.ScalarTransform4f().look_at([lens_x, lens_y, 0], [lens_x, lens_y, 1], [0, 1, 0]),
        "film": film(columns, rows, channels),
        "sampler": {"type": sampler, "sample_count": samples},
    }


def film(width: int, height: int, channels: int = 1) -> dict[str, Any]:
    """A film that neither filters nor rounds to half precision."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb" if channels == 3 else "luminance",
        "component_format": "float32",
    }


def texture_of(source: dict[str, Any]) -> dict[str, Any]:
    """Texels as they are: upright, not filtered, not wrapped, not read as sRGB."""
    import mitsuba as mi

    upright = mi.ScalarTransform3f().translate([0, 1]).scale([1, -1])  # row 0 would lie at v = 0, the bottom
    return {
        "type": "bitmap",
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
        "to_uv": upright,
        **source,
    }


def _one_sensor(camera: Camera, types: tuple[LensType, ...], sampler: str) -> Any:
    """All sub-imagers of some lens types as one sensor: a film pixel a measurement, looked up in tables."""
    import drjit as dr
    import mitsuba as mi

    # Powers of two: film coordinates come divided by the film's size, which then costs no digit.
    bits = max(sum(kind.measurements for kind in types) - 1, 1).bit_length()
    height = 1 << (bits // 2)
    width = 1 << (bits - bits // 2)
    tables = _tables(camera, types, width * height)

    class CompoundEye(mi.Sensor):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.tables = [mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in tables]
            self.pixel = float(camera.pixel_pitch)
            dr.make_opaque(self.tables)

        def sample_ray(
            self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True
        ) -> tuple[Any, Any]:
            del wavelength, aperture
            across, down = position.x * width, position.y * height
            column, row = _pixel(across, down, width, height)
            index = mi.UInt32(row) * width + mi.UInt32(column)
            corner_x, corner_y, lens_x, lens_y, depth = (dr.gather(mi.Float, t, index, active) for t in self.tables)
            x = corner_x + (across - column) * self.pixel
            y = corner_y + (down - row) * self.pixel
            ray = dr.zeros(mi.Ray3f)
            ray.o = mi.Point3f(lens_x, lens_y, 0)
            ray.d = dr.normalize(mi.Vector3f(*optics.through_pinhole(x, y, depth)))
            ray.time = time
            ray.maxt = dr.largest(mi.Float)
            return ray, mi.Spectrum(1)

        def sample_ray_differential(
            self, time: Any, wavelength: Any, position: Any, aperture: Any, active: Any = True
        ) -> tuple[Any, Any]:
            # The default traces three rays for a footprint that a texture read at its nearest texel never uses.
            ray, weight = self.sample_ray(time, wavelength, position, aperture, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

    properties = mi.Properties()
    properties["film"] = mi.load_dict(film(width, height))
    properties["sampler"] = mi.load_dict({"type": sampler, "sample_count": 16})
    return CompoundEye(properties)


def _pixel(across: Any, down: Any, width: int, height: int) -> tuple[Any, Any]:
    """Column and row of the film's pixel that a ray is for, not of the one that its coordinates may round up to.

    The renderer adds a pixel's number to an offset from 0 to 1 in float32; once in some hundred thousand rays the sum
    is the next pixel's number, which another sub-imager may have. Rays come in the order of pixels, which settles it;
    where they do not, the coordinates have to do.
    """
    import drjit as dr
    import mitsuba as mi

    lanes, pixels = dr.width(across), width * height
    column, row = dr.minimum(dr.floor(across), width - 1), dr.minimum(dr.floor(down), height - 1)
    if lanes % pixels == 0:
        number = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, lanes // pixels)
        by_order = mi.Float(number % width), mi.Float(number // width)
        near = (dr.abs(across - by_order[0] - 0.5) < 0.51) & (dr.abs(down - by_order[1] - 0.5) < 0.51)
        column, row = dr.select(near, by_order[0], column), dr.select(near, by_order[1], row)
    return column, row


def _tables(camera: Camera, types: tuple[LensType, ...], size: int) -> NDArray[np.float64]:
    """(5, size): x and y of each pixel's corner from its lens, the lens's x and y, the depth; the last one repeated."""
    columns: list[NDArray[np.float64]] = []
    for sub in (sub for sub in camera.sub_imagers if sub.type in types):
        row, column = (place.ravel() for place in np.indices(sub.type.pixels))
        x, y = optics.pixel_corner(camera, sub, row, column)
        same = np.ones_like(x)
        columns.append(np.stack([x, y, same * sub.lens[0], same * sub.lens[1], same * sub.depth]))
    known = np.concatenate(columns, axis=1)
    return np.concatenate([known, np.repeat(known[:, -1:], size - known.shape[1], axis=1)], axis=1)
