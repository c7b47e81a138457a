"""The camera and its target in Mitsuba: renders the readings of every sensor pixel from a picture on the target.

On llvm and cuda the rays of all pixels start together (`RayGenerator`) and Mitsuba's integrator follows them; on
scalar, where single rays would have to go through Python, there is a stock `perspective` sensor per sub-imager. (A
stock `batch` is no faster there, and occasionally assigns a ray to the wrong sub-imager: film coordinates are float32
and can round up to the next one's.) Around the target, or instead of it, there may be a world. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import isqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import block_seed
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.estimation import Sampler

from ..sampling.passes import AVERAGED, Plan, has_equal_boxes, margin
from ..sampling.samplers import fitting
from .averages import Averages
from .draws import Grid
from .plugins import black, depths, scene_of, stock_sensors, target_of
from .variant import activate, check_fast_variant, ignored_samples
from .worlds.placement import MILLIMETRES_AT_ORIGIN

if TYPE_CHECKING:
    from .rays import RayGenerator, Rays
    from .world import StagedWorld

TYPICAL = 0.5  # of the most by which float32 may move a point
EXACT_SUMS = 2**22, 2**50  # float32 sums of whole numbers below, and float64 ones, lose less than 1/4
MOST_TEXELS = 2**24  # that float32 can number
FAR = 1e4  # in distances of the target: how far stock sensors see into a world


class Renderer:
    """A camera in front of an emissive target.

    groups : lens types that are rendered together, by a name: "camera" if all are pinholes, else each lens type alone
    channels : number of pictures that can be on the target at once, as its colours
    exact_below : limit below which sums of whole numbers are exact
    is_fast : True on the backends where the rays of many pixels start together
    staged : the world, if there is one
    """

    _picture: FloatArray | None = None

    def __init__(
        self,
        camera: Camera,
        variant: str,
        sampler: Sampler = "multijitter",
        together: bool = True,
        world: Scene | None = None,
    ) -> None:
        """Build the Mitsuba scene; the target is black until `set_target` puts a picture on it.

        together : False renders every lens type separately
        world : scene with a [world] around the target or, if that has no picture, instead of it
        Raises InputError for a camera that this variant cannot render, or a world that cannot be built.
        """
        check_fast_variant(camera, variant)
        activate(variant)
        import mitsuba as mi

        self._sampler: Sampler = sampler
        self.camera = camera
        self.is_fast = fast = not variant.startswith("scalar")
        self.groups = _groups(camera, fast and together)
        self.channels = 3 if variant.endswith("rgb") and world is None else 1
        self.exact_below = EXACT_SUMS[fast]
        self._generators: dict[str, RayGenerator] = {}
        if fast:
            from .rays import RayGenerator

            for group, types in self.groups.items():
                self._generators[group] = RayGenerator(camera, types, sampler, world is not None)
        self._unit = 1.0  # radiance of a value of 1
        self.staged: StagedWorld | None = None
        self._sound: Callable[[FloatArray], FloatArray] = lambda readings: readings  # raises for a world's wrong light
        self._placement = MILLIMETRES_AT_ORIGIN
        self._texels = "target.emitter.radiance.data"
        self._texture: Any = None
        self._averages: dict[str, Averages] = {}  # of `_picture`
        if world is None:
            texture: Any = mi.load_dict(black(camera, self.channels)) if fast else black(camera, self.channels)
            self._scene = mi.load_dict(scene_of(target_of(camera, texture)))
            self._texture = texture if fast else None
            self._integrator: Any = self._scene.integrator()
        else:
            self._build_world(world, variant)
        far = 2.0 if world is None else FAR
        self._sensors: dict[str, dict[int, Any]] = {
            group: stock_sensors(camera, types, sampler, self.channels, far, self._placement)
            for group, types in ({} if fast else self.groups).items()
        }
        self._parameters = mi.traverse(self._scene)

    @property
    def direct_only(self) -> bool:
        """True if interreflections in a world are left out, since nothing there reflects."""
        return self.staged is not None and self.staged.direct_only

    def float32_samples(self, samples: int) -> int:
        """Return how many of a pixel's samples are summed in float32: one if sums are float64."""
        return 1 if self._generators else samples

    def set_target(self, *images: FloatArray) -> None:
        """Put pictures, (rows, columns), at most `channels` of them, on the target, if there is one.

        Signed values are allowed.
        """
        import mitsuba as mi

        if not self._texels:
            return
        self._picture, self._averages = (images[0] if self._texture is not None else None), {}
        texels = np.zeros((self.camera.rows, self.camera.columns, self.channels), dtype=np.float32)
        for channel, image in enumerate(images):
            texels[..., channel] = image * self._unit
        self._parameters[self._texels] = mi.TensorXf(texels)
        self._parameters.update()

    def expose(
        self,
        group: str,
        samples: int,
        seed: Callable[[int], int],
        subset: IntArray | None = None,
        block: slice | None = None,
    ) -> FloatArray:
        """Return the readings of a group's pixels for each picture, (channels, pixels in the order of measurements).

        An infinite uniform target reads its own value: the light of a pixel's rays is divided by their weights. Pixels
        that no light can reach read NaN.
        samples : rays per pixel
        seed : the sampler's seed by the index of a sensor: of the group on the fast backends, else of the sub-imager
        subset : pixels of the group; None: all of them
        block : one of `blocks`, on the fast backends; else, and if absent, all of them
        """
        ignored_samples()  # those of an earlier scene are not this one's
        if self._generators:
            blocks = self.blocks(group, samples, subset) if block is None else [block]
            rays = (self._rays(group, samples, seed, block, subset) for block in blocks)
            return np.concatenate([self._readings(group, block) for block in rays])[None]
        images = [self._film(sensor, samples, seed(index)) for index, sensor in self._sensors[group].items()]
        films = np.concatenate(images, axis=1) / self._unit
        return films if subset is None else films[:, subset]

    def _film(self, sensor: Any, samples: int, seed: int) -> FloatArray:
        """Return the radiances that a stock sensor records, (channels, pixels)."""
        import mitsuba as mi

        choices: Any = {"sensor": sensor, "integrator": self._integrator, "spp": samples, "seed": seed}
        rendered: Any = mi.render(self._scene, **choices)
        return self._sound(np.moveaxis(np.array(rendered, dtype=np.float64), -1, 0).reshape(self.channels, -1))

    def expose_alone(
        self, index: int, pixels: IntArray, work: Plan, seed: Callable[[int], int], sobol: bool = False
    ) -> FloatArray:
        """Return the readings of some pixels of one sub-imager in each of several passes, (passes, pixels).

        index : of the sub-imager in the camera;  pixels : of it; on the scalar backend the others cost as much
        seed : the sampler's seed by the number of a pass. Seeds differ between sub-imagers, so that the values do not
            depend on which others are rendered; on the fast backends, where the passes start together, the first counts
        sobol : True takes Sobol's points of the pupil, and exact averages over the pixel or Sobol's points of it, too;
            on the fast backends, without a world
        """
        sub, rows = self.camera.sub_imagers[index], self.camera.slices()[index]
        group = next(name for name, types in self.groups.items() if sub.type in types)
        if not self._generators:
            sensor = self._sensors[group][index]
            films = [self._film(sensor, work.samples, seed(number))[0, pixels] for number in range(work.passes)]
            return np.stack(films) / self._unit
        generator, subset = self._generators[group], pixels + (rows.start - self.rows(group).start)
        parts, start = list[FloatArray](), generator.sobol_rays if sobol else generator.rays
        averages = self._averages_of(sub.type) if sobol else None
        for block in generator.blocks(work.total, pixels.size):
            arguments = work.samples, block_seed(seed(0), block.start), block, work.passes, subset
            if averages is not None:
                rays, falloff = generator.middle_rays(*arguments)
                readings = self._weighed(group, rays, averages.light(rays.ray, falloff))
            else:
                readings = self._readings(group, start(*arguments))
            parts.append(readings.reshape(-1, work.passes).T)
        return np.concatenate(parts, axis=1)

    def expose_exactly(
        self, indices: Sequence[int], work: Plan, seeds: Sequence[Callable[[int], int]]
    ) -> Iterator[tuple[slice, FloatArray]]:
        """Yield the readings of adjacent sub-imagers of pinholes without error: measurements, and (passes, pixels).

        work : from `exact_plan`, by averages of the picture, or by grids in whose cells samples keep a margin to the
            edges. Of the four averages each is displaced along an axis by what float32 may round.
        seeds : of each pass, by the index of a sub-imager. The values of a sub-imager depend on no other one: on the
            fast backends all start together, on scalar they are rendered one by one.
        """
        sub, slices = self.camera.sub_imagers[indices[0]], self.camera.slices()
        if not self._generators:
            for index in indices:
                pixels = np.arange(slices[index].stop - slices[index].start)
                values = self.expose_alone(index, pixels, work, lambda number, index=index: seeds[number](index))
                yield slices[index], values
            return
        group = next(name for name, types in self.groups.items() if sub.type in types)
        generator, away = self._generators[group], margin(self.camera, sub.type)
        first, stop, start = slices[indices[0]].start, slices[indices[-1]].stop, self.rows(group).start
        averages = self._averages_of(sub.type) if work == AVERAGED else None
        keys = np.array([[seed(index) for seed in seeds] for index in range(len(slices))], dtype=np.int64)
        for block in generator.blocks(work.total if averages is None else 1, stop - first):
            part = slice(first + block.start, first + block.stop)
            pixels = np.arange(part.start - start, part.stop - start)
            if averages is None:
                rays = generator.grid_rays(Grid(isqrt(work.samples), away), work.passes, keys, pixels)
                yield part, self._readings(group, rays).reshape(-1, work.passes).T
                continue
            rays, by = generator.middles(pixels), TYPICAL * away
            met = (averages.light(rays.ray, moved=moved) for moved in ((by, 0), (-by, 0), (0, by), (0, -by)))
            yield part, np.stack([self._weighed(group, rays, light) for light in met])

    def blocks(self, group: str, samples: int, subset: IntArray | None = None) -> list[slice]:
        """Divide the pixels of a group into blocks whose rays start together. Only on the fast backends."""
        pixels = None if subset is None else subset.size
        return self._generators[group].blocks(fitting(self._sampler, samples), pixels)

    def _rays(
        self, group: str, samples: int, seed: Callable[[int], int], block: slice, subset: IntArray | None
    ) -> Rays:
        first = seed(list(self.groups).index(group))
        return self._generators[group].rays(samples, block_seed(first, block.start), block, subset=subset)

    def _readings(self, group: str, rays: Rays) -> FloatArray:
        """Return the readings of the pixels of these rays: (pixels of the block,)."""
        sampler = self._generators[group].sampler
        if self._texture is None:
            light = self._integrator.sample(self._scene, sampler, rays.ray, None, True)[0].x
        else:
            light = self._radiance(rays.ray)
        return self._weighed(group, rays, light)

    def _weighed(self, group: str, rays: Rays, light: Any) -> FloatArray:
        """Return the readings of the pixels of these rays from the light that each meets: (pixels of the block,)."""
        if rays.weight is None:
            return self._sound(rays.sums(light)[0] / rays.samples / self._unit)
        total, weight = rays.sums(light * rays.weight, rays.weight)
        self._sound(total / rays.samples / self._unit)
        share = self.captured(group) / self._unit
        return np.divide(total * share, weight, out=np.full(weight.size, np.nan), where=weight > 0)

    def _averages_of(self, lens_type: LensType) -> Averages | None:
        """Return the picture's averages over the boxes of a lens type, None where these are not equal."""
        if self._picture is None or not has_equal_boxes(self.camera, lens_type):
            return None
        if lens_type.name not in self._averages:
            self._averages[lens_type.name] = Averages(self.camera, lens_type, self._picture * self._unit)
        return self._averages[lens_type.name]

    def _radiance(self, ray: Any) -> Any:
        """Return the target's radiance where rays meet it: what the integrator yields, in a third of the time."""
        import mitsuba as mi

        met = self._scene.ray_intersect_preliminary(ray, coherent=True)
        at = met.compute_surface_interaction(ray, int(mi.RayFlags.UV))
        return self._texture.eval_1(at, at.is_valid())

    def depths(self, pinhole: Camera, seed: int) -> FloatArray:
        """Return the distance along z of what a pinhole camera's only sub-imager sees; see `plugins.depths`."""
        return depths(self._scene, pinhole, seed, FAR, self._placement)

    def hits(
        self, group: str, samples: int, seed: Callable[[int], int], block: slice, subset: IntArray | None = None
    ) -> tuple[IntArray, FloatArray | None]:
        """Return the pixel of f that each ray of a block meets, (pixels, samples), -1 off the target; and weights.

        The rays are those of `expose` with the same samples and seed. Only on the fast backends.
        """
        import drjit as dr

        if self.camera.unknowns >= MOST_TEXELS:
            raise InputError(
                f"expected a target of fewer than 2^24 pixels, got {self.camera.unknowns}; make it smaller"
            )
        self.set_target(np.arange(1.0, self.camera.unknowns + 1).reshape(self.camera.shape))
        rays = self._rays(group, samples, seed, block, subset)
        met = self._scene.ray_intersect(rays.ray)
        radiance = met.emitter(self._scene).eval(met, met.is_valid()).x
        dr.eval(radiance, rays.weight)
        texels = np.rint(np.array(radiance)).astype(np.int64) - 1
        weight = None if rays.weight is None else np.array(rays.weight, dtype=np.float64).reshape(-1, rays.samples)
        return texels.reshape(-1, rays.samples), weight

    def captured(self, group: str) -> float:
        """Return the share of the light that the rays of a group represent; the rest lands far away."""
        return self._generators[group].lens.captured

    def _build_world(self, world: Scene, variant: str) -> None:
        """Use a world, whose white is a number, as the scene, with the target in it if it has a picture."""
        from .world import TARGET, stage, white_of

        self._unit, has_target = white_of(world) / WHITE, world.target.image is not None
        target = target_of(self.camera, black(self.camera, self.channels)) if has_target else None
        self.staged = staged = stage(world, variant, target)
        self._scene, self._integrator, self._placement = staged.scene, staged.integrator, staged.placement
        self._sound = staged.sound_readings
        self._texels = f"{TARGET}.{self._texels.partition('.')[2]}" if has_target else ""
        for generator in self._generators.values():
            generator.follow(partial(staged.distance, far=FAR * self.camera.distance), staged.placement)

    def rows(self, group: str) -> slice:
        """Return the rows of H, or measurements, of a group's pixels."""
        start = 0
        for lens_type in self.camera.types:
            if lens_type in self.groups[group]:
                return slice(start, start + sum(member.measurements for member in self.groups[group]))
            start += lens_type.measurements
        raise KeyError(group)


def _groups(camera: Camera, together: bool) -> dict[str, tuple[LensType, ...]]:
    """Return the lens types that are rendered together, by a name."""
    alike = {(each.open, camera.height(each)) for each in camera.types}
    if together and len(alike) == 1 and all(each.optics.is_pinhole for each in camera.types):
        return {"camera": camera.types}
    return {lens_type.name: (lens_type,) for lens_type in camera.types}
