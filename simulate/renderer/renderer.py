"""The camera and its target in Mitsuba: a picture on the target goes in, what every sensor pixel reads comes out.

On llvm and cuda the rays of all pixels start at once (`Eye`) and Mitsuba's integrator follows them; on scalar, where a
ray at a time would have to go through Python, a stock `perspective` sensor a sub-imager does. (A stock `batch` is no
faster there, and gives now and then a ray to the wrong sub-imager: film coordinates are float32 and can round up to
the next one's.) Around the target, or instead of it, there may be a whole world. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Sampler, Scene

from ..sampling.passes import Plan
from ..sampling.samplers import fitting
from ..sampling.seeds import seed_of
from .plugins import BLOCK, scene_of, stock_sensor, target_of, texture_of
from .variant import activate, check_fast_variant

if TYPE_CHECKING:
    from .rays import RayGenerator, Rays

EXACT_SUMS = 2**22, 2**50  # whole numbers below come out of float32 sums, and of float64 ones, with less than 1/4 lost
MOST_TEXELS = 2**24  # that float32 can number
FAR = 1e4  # in target's distances: how far a world is looked into by stock sensors


class Renderer:
    """A camera in front of an emissive target, ready to be exposed.

    `groups` are the lens types that are exposed at once, by a name: the whole camera where all are pinholes and that is
    wanted (`together`), else each lens type by itself. `channels` is how many pictures can be on the target at once,
    as its colours. `exact` is the number below which sums of whole numbers come out whole.
    """

    def __init__(
        self,
        camera: Camera,
        variant: str,
        sampler: Sampler = "multijitter",
        together: bool = True,
        around: Scene | None = None,
    ) -> None:
        """Build the Mitsuba scene; the target is black until `show` puts a picture on it.

        around : whose world stands around the target or, where that has no picture, instead of it; absent: none does
        Raises InputError for a camera that this variant cannot render, or a world that cannot be built.
        """
        check_fast_variant(camera, variant)
        activate(variant)
        import mitsuba as mi

        self._sampler: Sampler = sampler
        self.camera = camera
        fast = not variant.startswith("scalar")
        self.groups: dict[str, tuple[LensType, ...]] = {kind.name: (kind,) for kind in camera.types}
        if fast and together and all(kind.optics.is_pinhole for kind in camera.types):
            self.groups = {"camera": camera.types}
        self.channels = 3 if variant.endswith("rgb") and around is None else 1
        self.exact = EXACT_SUMS[fast]
        self._far = 2.0 if around is None else FAR
        self._eyes: dict[str, RayGenerator] = {}
        self._sensors: dict[str, dict[int, Any]] = {}
        if fast:
            from .rays import RayGenerator

            self._eyes = {group: RayGenerator(camera, types, sampler) for group, types in self.groups.items()}
        else:
            self._sensors = {group: self._sensors_of(types, sampler) for group, types in self.groups.items()}
        self._unit = 1.0  # radiance of a value of 1
        self.straight = False  # whether light that bounces in a world was left out
        self._texels = "target.emitter.radiance.data"
        if around is None:
            self._scene = mi.load_dict(scene_of(target_of(camera, self._black())))
            self._integrator: Any = self._scene.integrator()
        else:
            self._enter(around, variant)
        self._parameters = mi.traverse(self._scene)

    @property
    def even(self) -> bool:
        """Whether every ray of a pixel stands for the same light."""
        return all(eye.even for eye in self._eyes.values())

    def summed(self, samples: int) -> int:
        """How many of a pixel's samples are added up in float32: none but one where sums are float64."""
        return 1 if self._eyes else samples

    def set_target(self, *images: NDArray[np.float64]) -> None:
        """Put pictures, (rows, columns), at most `channels` of them, on the target, if there is one.

        Signed values are allowed.
        """
        import mitsuba as mi

        if not self._texels:
            return
        texels = np.zeros((self.camera.rows, self.camera.columns, self.channels), dtype=np.float32)
        for channel, image in enumerate(images):
            texels[..., channel] = image * self._unit
        self._parameters[self._texels] = mi.TensorXf(texels)
        self._parameters.update()

    def expose(self, group: str, samples: int, seed: Callable[[int], int]) -> NDArray[np.float64]:
        """What the sensor pixels of a group read of each picture, (channels, pixels in the order of measurements).

        A uniform target without an end reads its own value: the light of a pixel's rays is divided by what they would
        bring from there. Pixels that no light can reach read NaN.
        samples : rays a pixel
        seed : the sampler's seed by the place of a sensor: of a group where a group is one sensor, else a sub-imager
        """
        if self._eyes:
            blocks = self.blocks(group, samples)
            return np.concatenate([self._seen(group, self._rays(group, samples, seed, one)) for one in blocks])[None]
        images: list[NDArray[np.float64]] = []
        for place, sensor in self._sensors[group].items():
            images.append(self._film(sensor, samples, seed(place)))
        return np.concatenate(images, axis=1) / self._unit

    def _film(self, sensor: Any, samples: int, seed: int) -> NDArray[np.float64]:
        """Radiances that a stock sensor reads, (channels, pixels)."""
        import mitsuba as mi

        choices: Any = {"sensor": sensor, "integrator": self._integrator, "spp": samples, "seed": seed}
        rendered: Any = mi.render(self._scene, **choices)
        return np.moveaxis(np.array(rendered, dtype=np.float64), -1, 0).reshape(self.channels, -1)

    def expose_alone(
        self, place: int, which: NDArray[np.int64], work: Plan, seed: Callable[[int], int]
    ) -> NDArray[np.float64]:
        """What some pixels of one sub-imager read in each of several passes, (passes, pixels), as `expose` has it.

        place : of the sub-imager in the camera;  which : of its pixels; on the slow backends the others cost as much
        seed : the sampler's seed by the number of a pass. They are no other sub-imager's, so that the values are the
            same whoever else is exposed; on the fast backends, where the passes start together, the first counts
        """
        sub, whole = self.camera.sub_imagers[place], self.camera.slices()[place]
        group = next(name for name, types in self.groups.items() if sub.type in types)
        if not self._eyes:
            sensor = self._sensors[group][place]
            films = [self._film(sensor, work.samples, seed(number))[0, which] for number in range(work.passes)]
            return np.stack(films) / self._unit
        eye, among = self._eyes[group], which + (whole.start - self.places(group).start)
        found: list[NDArray[np.float64]] = []
        for block in eye.blocks(work.total, which.size):
            rays = eye.rays(work.samples, seed_of(seed(0), block.start), block, work.passes, among)
            found.append(self._seen(group, rays).reshape(-1, work.passes).T)
        return np.concatenate(found, axis=1)

    def blocks(self, group: str, samples: int) -> list[slice]:
        """The pixels of a group whose rays start together, block by block. Only on the fast backends."""
        return self._eyes[group].blocks(fitting(self._sampler, samples))

    def _rays(self, group: str, samples: int, seed: Callable[[int], int], block: slice) -> Rays:
        first = seed(list(self.groups).index(group))
        return self._eyes[group].rays(samples, seed_of(first, block.start), block)

    def _seen(self, group: str, rays: Rays) -> NDArray[np.float64]:
        """What the pixels of these rays read: (pixels of the block,)."""
        light = self._follow(group, rays.ray)
        if rays.weight is None:
            return rays.sums(light)[0] / rays.samples / self._unit
        brought, reach = rays.sums(light * rays.weight, rays.weight)
        return np.divide(brought, reach * self._unit, out=np.full(reach.size, np.nan), where=reach > 0)

    def depths(self, eye: Camera, seed: int) -> NDArray[np.float64]:
        """Distance along z of what a pinhole camera's only sub-imager sees at a point of each pixel, (pixels,).

        Infinite where it sees no surface. Surfaces that let light through are seen like any other.
        """
        import mitsuba as mi

        (sub,) = eye.sub_imagers
        sensor = mi.load_dict(stock_sensor(eye, sub, "independent", 1, far=FAR))
        places = mi.load_dict({"type": "aov", "aovs": "place:position", "block_size": BLOCK})
        choices: Any = {"sensor": sensor, "integrator": places, "spp": 1, "seed": seed}
        rendered: Any = mi.render(self._scene, **choices)
        z = np.array(rendered, dtype=np.float64)[..., -1].ravel()
        return np.where(z > 0, z, np.inf)

    def hits(
        self, group: str, samples: int, seed: Callable[[int], int], block: slice
    ) -> tuple[NDArray[np.int64], NDArray[np.float64] | None]:
        """Which pixel of f each ray of a block's pixels meets, (pixels, samples), -1 beside the target; and its weight.

        The rays are those of `expose` with the same samples and seed. Only on the fast backends.
        """
        import drjit as dr

        if self.camera.unknowns >= MOST_TEXELS:
            raise InputError(f"a target of {self.camera.unknowns} pixels: rays are told apart on at most 2^24")
        self.set_target(np.arange(1.0, self.camera.unknowns + 1).reshape(self.camera.shape))
        rays = self._rays(group, samples, seed, block)
        met = self._scene.ray_intersect(rays.ray)
        shining = met.emitter(self._scene).eval(met, met.is_valid()).x
        dr.eval(shining, rays.weight)
        texels = np.rint(np.array(shining)).astype(np.int64) - 1
        weight = None if rays.weight is None else np.array(rays.weight, dtype=np.float64).reshape(-1, rays.samples)
        return texels.reshape(-1, rays.samples), weight

    def gathered(self, group: str, samples: int, seed: Callable[[int], int]) -> NDArray[np.float64]:
        """Mean weight of each pixel's rays, (pixels,): the light that reaches it from a uniform world, relative."""
        eye, found = self._eyes[group], list[NDArray[np.float64]]()
        if eye.even:
            return np.ones(eye.pixels)
        for block in self.blocks(group, samples):
            rays = self._rays(group, samples, seed, block)
            found.append(rays.sums(rays.weight)[0] / rays.samples)
        return np.concatenate(found)

    def tail(self, group: str) -> float:
        """Pixels of f by which rare rays of a group may land further out than others."""
        return self._eyes[group].lens.tail

    def _follow(self, group: str, ray: Any) -> Any:
        """Radiance along each ray."""
        return self._integrator.sample(self._scene, self._eyes[group].sampler, ray, None, True)[0].x

    def _enter(self, around: Scene, variant: str) -> None:
        """Take a world for the scene, and the target into it, if it has a picture."""
        import mitsuba as mi

        from .world import TARGET, stage, world_of

        self._unit = world_of(around).white / WHITE
        shown = around.target.image is not None
        staged = stage(around, variant, mi.load_dict(target_of(self.camera, self._black())) if shown else None)
        self._scene, self._integrator, self.straight = staged.scene, staged.integrator, staged.straight
        self._texels = f"{TARGET}.{self._texels.partition('.')[2]}" if shown else ""

    def _sensors_of(self, types: tuple[LensType, ...], sampler: Sampler) -> dict[int, Any]:
        import mitsuba as mi

        return {
            place: mi.load_dict(stock_sensor(self.camera, sub, sampler, 16, self.channels, self._far))
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
