"""The camera and its target in Mitsuba: renders the readings of every sensor pixel from a picture on the target.

On llvm and cuda the rays of all pixels start together (`RayGenerator`) and Mitsuba's integrator follows them; on
scalar, where single rays would have to go through Python, there is a stock `perspective` sensor per sub-imager. (A
stock `batch` is no faster there, and occasionally assigns a ray to the wrong sub-imager: film coordinates are float32
and can round up to the next one's.) Around the target, or instead of it, there may be a world. Lengths are millimetres.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import isqrt
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Rays as Kind
from ommatid.runtime.streams import block_seed, sampler_seeds
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.estimation import Sampler

from ..sampling.checkpoint import Checkpoint, State
from ..sampling.passes import Plan, Tally, has_equal_boxes, margin
from ..sampling.samplers import fitting
from .averages import Averages
from .draws import SobolDraws
from .loaded import dr, mi
from .plugins import black, scene_of, stock_sensors, target_of, twice_if_single
from .rays import Pixels, RayGenerator, Rays, Seed
from .variant import activate, check_fast_variant, ignored_samples
from .worlds.placement import MILLIMETRES_AT_ORIGIN

if TYPE_CHECKING:
    from .world import StagedWorld

TYPICAL = 0.5  # of the most by which float32 may move a point
EXACT_SUMS = 2**22, 2**50  # float32 sums of whole numbers below, and float64 ones, lose less than 1/4
MOST_TEXELS = 2**24  # that float32 can number
FAR = 1e4  # in distances of the target: how far stock sensors see into a world
# Where rays start: at the points of Mitsuba's sampler; at Sobol's of pixel and pupil, or of the pupil alone where the
# picture is averaged over each pixel exactly; and by `exact_plan` in the cells of a grid, or by averages alone.
Points = Literal["sampler", "sobol", "grid", "averages"]


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
        self._sampler: Sampler = sampler
        self.camera = camera
        self.is_fast = fast = not variant.startswith("scalar")
        self.groups = _groups(camera, fast and together)
        self.channels = 3 if variant.endswith("rgb") and world is None else 1
        self.exact_below = EXACT_SUMS[fast]
        self._generators: dict[str, RayGenerator] = {}
        if fast:
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
        self._sensors = [] if fast else stock_sensors(camera, sampler, self.channels, far, self._placement)
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
        if not self._texels:
            return
        self._picture, self._averages = (images[0] if self._texture is not None else None), {}
        texels = np.zeros((self.camera.rows, self.camera.columns, self.channels), dtype=np.float32)
        for channel, image in enumerate(images):
            texels[..., channel] = image * self._unit
        self._parameters[self._texels] = mi.TensorXf(twice_if_single(texels))
        self._parameters.update()

    def pixels(self, group: str, subset: IntArray | None = None) -> Pixels:
        """Return the pixels of a group, or a subset of them."""
        rows = self.rows(group)
        count = rows.stop - rows.start if subset is None else subset.size
        return Pixels(group, slice(0, count), subset, list(self.groups).index(group))

    def sub_imagers(self, indices: Sequence[int], subset: IntArray | None = None) -> Pixels:
        """Return the pixels of adjacent sub-imagers of one lens type, or a subset of those of one."""
        lens_type, slices = self.camera.sub_imagers[indices[0]].type, self.camera.slices()
        group = next(name for name, types in self.groups.items() if lens_type in types)
        start = self.rows(group).start
        first, stop = slices[indices[0]].start - start, slices[indices[-1]].stop - start
        block, numbers = (slice(first, stop), None) if subset is None else (slice(0, subset.size), first + subset)
        return Pixels(group, block, numbers, indices[0])

    def blocks(self, pixels: Pixels, samples: int) -> list[Pixels]:
        """Divide pixels into blocks whose rays, `samples` a pixel, start together: one on scalar."""
        return pixels.blocks(samples) if self.is_fast else [pixels]

    def mean_of_passes(
        self, rays: Kind, seed: int, work: Plan, progress: Progress = no_progress, checkpoint: Checkpoint | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mean over passes with seeds of their own on every sensor pixel, and its variance: (M,) each.

        All passes of the pixels whose rays start together come before those of the next, so that memory holds few.
        """
        blocks = [block for group in self.groups for block in self.blocks(self.pixels(group), work.samples)]
        (mean, variance), first = np.zeros((2, self.camera.measurements)), 0
        state = State() if checkpoint is None else checkpoint.state()
        if state:
            mean, variance, first = state["mean"], state["variance"], int(state["block"])
        for number, block in list(enumerate(blocks))[first:]:
            tally = Tally(block.count)
            tally.resume("light", state)
            state = State()  # the other blocks have not begun
            for index in range(tally.count, work.passes):
                seeds = [sampler_seeds(seed, rays, index, work.passes)]
                tally.add(self.expose(block, work.samples, seeds)[0, 0])
                if checkpoint is not None:
                    done = {"mean": mean, "variance": variance, "block": np.array(number)}
                    checkpoint.offer(lambda done=done, tally=tally: {**done, **tally.state("light")})
                progress((number + (index + 1) / work.passes) / len(blocks))
            rows = self.rows(block.group).start + block.numbers
            mean[rows], variance[rows] = tally.mean, tally.variance
        return mean, variance

    def expose(self, pixels: Pixels, samples: int, seeds: Sequence[Seed], points: Points = "sampler") -> FloatArray:
        """Return the readings of pixels for each picture and pass: (channels, passes, pixels).

        An infinite uniform target reads its own value: the light of a pixel's rays is divided by their weights. Pixels
        that no light can reach read NaN.
        samples : rays per pixel in a pass;  points : at which they start, on the fast backends
        seeds : the sampler's of each pass, by the index of a sensor. On the fast backends, where the passes start
            together, the first counts for `pixels.sensor`; on scalar, and of a grid, each counts for every sub-imager,
            whose values then depend on no other one.
        """
        ignored_samples()  # those of an earlier scene are not this one's
        if not self.is_fast:
            return self._films(pixels, samples, seeds)
        samples = fitting(self._sampler, samples) if points == "sampler" else samples
        rays = 1 if points == "averages" else samples * len(seeds)
        parts = [self._passes(block, Plan(len(seeds), samples), seeds, points) for block in pixels.blocks(rays)]
        return np.concatenate(parts, axis=1)[None]

    def _films(self, pixels: Pixels, samples: int, seeds: Sequence[Seed]) -> FloatArray:
        """Render the sub-imagers of pixels by stock sensors: (channels, passes, pixels)."""
        rows = pixels.numbers + self.rows(pixels.group).start
        parts: list[FloatArray] = []
        for index, own in enumerate(self.camera.slices()):
            first, stop = np.searchsorted(rows, (own.start, own.stop))
            films: list[FloatArray] = []
            for seed in seeds if stop > first else ():
                choices: Any = {"sensor": self._sensors[index], "integrator": self._integrator, "seed": seed(index)}
                rendered: Any = mi.render(self._scene, **choices, spp=samples)
                film = np.moveaxis(np.array(rendered, dtype=np.float64), -1, 0).reshape(self.channels, -1)
                films.append(self._sound(film)[:, rows[first:stop] - own.start])
            parts += [np.stack(films, axis=1)] if films else []
        return np.concatenate(parts, axis=2) / self._unit

    def _passes(self, pixels: Pixels, work: Plan, seeds: Sequence[Seed], points: Points) -> FloatArray:
        """Return the readings of pixels whose rays start together: (passes, pixels)."""
        generator, seed = self._generators[pixels.group], block_seed(seeds[0](pixels.sensor), pixels.block.start)
        lens_type, light = self.camera.sub_imagers[pixels.sensor].type, None
        averages = self._averages_of(lens_type) if points in ("sobol", "averages") else None
        if averages is not None and points == "averages":
            draws = SobolDraws(seed, pixels.count, 1, middle=True)  # a pinhole draws nothing
            rays, by = generator.rays(pixels, Plan(1, 1), draws), TYPICAL * margin(self.camera, lens_type)
            met = (averages.light(rays.ray, moved=moved) for moved in ((by, 0), (-by, 0), (0, by), (0, -by)))
            return np.stack([self._weighed(pixels.group, rays, light) for light in met])
        if points == "sampler":
            rays = generator.sampled(pixels, work, seed)
        elif points == "grid":
            draws = generator.grid(pixels, isqrt(work.samples), margin(self.camera, lens_type), seeds)
            rays = generator.rays(pixels, work, draws)
        else:
            draws = SobolDraws(seed, pixels.count * work.total, work.samples, middle=averages is not None)
            rays = generator.rays(pixels, work, draws)
            light = None if averages is None else averages.light(rays.ray, generator.falloff(pixels, work))
        light = self._light(pixels.group, rays) if light is None else light
        return self._weighed(pixels.group, rays, light).reshape(-1, work.passes).T

    def _light(self, group: str, rays: Rays) -> Any:
        """Return the radiance that each ray meets."""
        if self._texture is None:
            return self._integrator.sample(self._scene, self._generators[group].sampler, rays.ray, None, True)[0].x
        # What the integrator yields, in a third of the time.
        met = self._scene.ray_intersect_preliminary(rays.ray, coherent=True)
        at = met.compute_surface_interaction(rays.ray, int(mi.RayFlags.UV))
        return self._texture.eval_1(at, at.is_valid())

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

    def hits(self, pixels: Pixels, samples: int, seed: Seed) -> tuple[IntArray, FloatArray | None]:
        """Return the pixel of f that each ray of some pixels meets, (pixels, samples), -1 off the target; and weights.

        The rays are those of `expose` with the same samples and seed; all start together. Only on the fast backends.
        """
        if self.camera.unknowns >= MOST_TEXELS:
            raise InputError(
                f"expected a target of fewer than 2^24 pixels, got {self.camera.unknowns}; make it smaller"
            )
        self.set_target(np.arange(1.0, self.camera.unknowns + 1).reshape(self.camera.shape))
        work = Plan(1, fitting(self._sampler, samples))
        first = block_seed(seed(pixels.sensor), pixels.block.start)
        rays = self._generators[pixels.group].sampled(pixels, work, first)
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
        types = self.groups[group]
        slices = dict(zip(self.camera.types, self.camera.type_slices(), strict=True))
        return slice(slices[types[0]].start, slices[types[-1]].stop)


def _groups(camera: Camera, together: bool) -> dict[str, tuple[LensType, ...]]:
    """Return the lens types that are rendered together, by a name."""
    alike = {(each.open, camera.height(each)) for each in camera.types}
    if together and len(alike) == 1 and all(each.optics.is_pinhole for each in camera.types):
        return {"camera": camera.types}
    return {lens_type.name: (lens_type,) for lens_type in camera.types}
