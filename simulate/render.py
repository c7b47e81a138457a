"""Render what every sub-imager sees: passes with seeds of their own, their mean, its variance, then the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.files import digest, fingerprint
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.negligible import negligible_shot_noise
from ommatid.scenes.recording import Recording
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import shrink_variances
from ommatid.scenes.stack import STRAIGHT, Stack, stack_from_recording
from ommatid.scenes.tables.sensor import SensorTable

from .renderer.variant import choose
from .sampling.checkpoint import Checkpoint
from .sampling.passes import OverPasses, Plan, Tally, plan, rounding_variance
from .sampling.seeds import sampler_seeds


@dataclass(frozen=True)
class Rendering(OverPasses):
    """Light on every sensor pixel, (M,): the mean of the passes, and the variance of that mean from their scatter.

    straight : whether light that bounces in a world was left out, since nothing there reflects any
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    straight: bool

    def stated(self, camera: Camera) -> NDArray[np.float64]:
        """The variance, (M,), drawn towards its sub-image's and never below float32's rounding."""
        settled = np.concatenate([shrink_variances(self.variance[place], self.passes) for place in camera.slices()])
        return np.maximum(settled, rounding_variance(self.mean, self.samples))


def made_from(setup: Setup) -> str:
    """Fingerprint of everything that the values of a stack depend on."""
    scene, world = setup.scene, dict[str, Any]()
    if scene.world is not None:
        from .renderer.world import describe

        world = {"world": describe(scene)}
    return fingerprint(
        {
            **world,
            "camera": setup.camera.describe(),
            "simulated": setup.simulated.describe(),
            "target": digest(setup.image.astype(np.float32)),
            "noise": scene.noise.model_dump() if scene.noise else None,
            "sensor": scene.sensor.model_dump() if scene.sensor else None,
            "render": scene.render.model_dump(exclude_none=True),
            "versions": versions("mitsuba"),
        }
    )


def light(
    setup: Setup,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
    work: Plan | None = None,
) -> Rendering:
    """Render the light alone, before the sensor. Raises InputError if the variant asked for does not work here.

    partial : where passes that are done are kept and found again
    work : passes and their samples; absent: as the scene's samples ask
    """
    from .renderer.renderer import Renderer

    scene, camera = setup.scene, setup.camera
    if scene.render.samples == "auto":
        raise ValueError("expected a number of samples, got 'auto', which `light_until` renders")
    variant = choose(scene.render.variant)
    work = plan(scene.render.samples, scene.render.sampler) if work is None else work
    around = None if scene.world is None else scene
    rig = Renderer(setup.simulated, variant, scene.render.sampler, around=around)
    rig.set_target(setup.image)
    tally = Tally(camera.measurements)
    if partial is not None:
        tally.resume("light", partial.state())
    for number in range(tally.count, work.passes):
        values = np.empty(camera.measurements)
        for group in rig.groups:
            seed = sampler_seeds(scene.render.seed, "data", number, work.passes)
            values[rig.places(group)] = rig.expose(group, work.samples, seed)[0]
        tally.add(values)
        if partial is not None:
            partial.offer(lambda: tally.state("light"))
        progress((number + 1) / work.passes)
    return Rendering(
        passes=work.passes,
        samples=work.samples,
        variant=variant,
        first_seed=sampler_seeds(scene.render.seed, "data", 0, work.passes)(0),
        mean=tally.mean,
        variance=tally.variance,
        straight=rig.straight,
    )


def render(
    setup: Setup,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
    truth: NDArray[np.float64] | None = None,
) -> Stack:
    """Render and record the sub-images of the setup's image on its target.

    truth : what the estimate is compared with; absent: the image
    The variance of each pixel's mean is drawn towards its sub-image's and never below float32's rounding.
    Raises InputError if the variant asked for does not work here.
    """
    scene, start = setup.scene, perf_counter()
    if scene.render.samples == "auto":
        from .adaptive_render import render_until

        rendering = render_until(setup, progress, partial)
    else:
        rendering = light(setup, progress, partial)
    record: dict[str, Any] = {
        "fingerprint": made_from(setup),
        "truth": digest((setup.image if truth is None else truth).astype(np.float32)),
        "seconds": perf_counter() - start,
        "seed": scene.render.seed,
        "sampler": scene.render.sampler,
        **rendering.record(),
        **({STRAIGHT: True} if rendering.straight else {}),
        "versions": versions("mitsuba", "drjit", "OpenEXR"),
    }
    return exposed(setup, rendering.mean, rendering.stated(setup.camera), record)


def exposed(setup: Setup, light: NDArray[np.float64], variance: NDArray[np.float64], record: dict[str, Any]) -> Stack:
    """What the scene's sensor records of light, (M,), whose variances are known; noise by the scene's seed."""
    scene, camera, values = setup.scene, setup.camera, light
    if scene.sensor is not None:
        return stack_from_recording(setup.resolved, camera, _exposed(setup, scene.sensor, light), variance, record)
    if scene.noise is not None:
        from .sensor.gaussian import expose, generators

        values = expose(values, scene.noise, generators(camera, scene.render.seed), camera.slices())
    return Stack(setup.resolved, camera, values, variance, record)


def _exposed(setup: Setup, sensor: SensorTable, light: NDArray[np.float64]) -> Recording:
    from .sensor.emva1288 import record
    from .sensor.response import response

    dark = np.isnan(light)  # no light can reach these pixels; so they are dead, and known by their flat
    freed = np.where(dark, 0.0, response(setup))
    shot = negligible_shot_noise(setup.scene, setup.camera) is None
    return record(np.where(dark, 0.0, light), freed, sensor, setup.camera, setup.scene.render.seed, shot)
